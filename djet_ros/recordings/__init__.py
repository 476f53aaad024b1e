"""Bags, datasets and trajectory files: what is read from a disk, and written to it."""
