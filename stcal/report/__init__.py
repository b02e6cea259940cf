"""Report pages that open offline, for every system."""
