"""An identified robot at work: compensation, verification, poses to measure at."""
