"""Range of validity of a registration."""
