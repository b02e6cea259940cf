"""Design of targets whose patterns of circles cannot be mistaken for one another."""
