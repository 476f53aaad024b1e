"""A recording through the odometry into a results folder, and errors against ground truth."""
