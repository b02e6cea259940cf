"""Poses, views and motions that the methods solve from."""
