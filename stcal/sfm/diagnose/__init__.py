"""Why something was left out of a finished run."""
