"""Whether the points can tell what is asked of them, and mistakes that they show."""
