"""Reports and files of hand-eye calibrations, for people and for other programs."""
