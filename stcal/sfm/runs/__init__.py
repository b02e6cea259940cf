"""What a run is asked for and answers, and its folder: written, kept, and read back."""
