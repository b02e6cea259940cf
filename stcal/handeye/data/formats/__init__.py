"""Poses as other programs write them, each file told by its content: read :mod:`.tell` first."""
