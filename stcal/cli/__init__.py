"""Command line: parse, load, call, save."""
