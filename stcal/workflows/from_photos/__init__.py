"""Joint values that reach points, from photographs of the target on an arm, in one run."""
