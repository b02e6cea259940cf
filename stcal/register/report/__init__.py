"""Results of a registration as text, page, pictures and file."""
