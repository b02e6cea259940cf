"""Photographs that need more than OpenCV's decoders: HEIC, raw files, and mosaics of coloured pixels."""
