"""Choice of photographs to take: before any is taken, and after a run."""
