"""Models of groups from labelled observations: the COLMAP database, the initial pair, incremental mapping."""
