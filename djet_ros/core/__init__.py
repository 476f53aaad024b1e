"""Floor 1: images and matrices in, frozen results out. No ROS, no files, no clock but timings."""
