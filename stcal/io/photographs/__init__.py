"""Photographs that need more than OpenCV's decoders: HEIC, videos, and those that are refused."""
