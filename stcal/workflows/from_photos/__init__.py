"""The way from photographs of the target on an arm to joint values that reach points, in one go."""
