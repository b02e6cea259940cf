"""Options and result of a run, and its folder: written, kept, and read back."""
