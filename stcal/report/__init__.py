"""Report pages that open off line, for every system."""
