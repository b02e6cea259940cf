"""Fits of the three models, the search for what agrees, and what the answer is worth."""
