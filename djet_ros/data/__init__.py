"""Floor 2, data: image sequences, bags and trajectory files. Everything that touches a disk."""
