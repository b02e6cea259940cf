"""From labelled observations to a model of each group: the COLMAP database, the initial pair, incremental mapping."""
