"""Pose graphs, their files, keyframes, places seen again, loops, and the back end."""
