"""Reports and files of locate, for people, programs and robots."""
