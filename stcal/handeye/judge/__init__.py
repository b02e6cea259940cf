"""What the poses can tell, which conventions they follow, and what should be known about a solution."""
