"""Hand-eye calibration of several cameras of one robot that see one board, solved together."""
