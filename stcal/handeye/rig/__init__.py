"""Several cameras of one robot about one board, solved together."""
