"""Report of a run for people, and comparison of a run with a known truth."""
