"""Search for why something was left out of a finished run."""
