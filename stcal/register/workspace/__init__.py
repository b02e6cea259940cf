"""Where a registration holds."""
