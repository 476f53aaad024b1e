"""Offline SLAM: keyframes, loops between them, and a graph optimised by GTSAM."""
