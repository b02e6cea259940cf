"""Fits of the three models, the search for a consensus, and the uncertainty of the result."""
