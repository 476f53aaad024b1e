"""Images and matrices in, frozen results out. No ROS, no files, no clock but timings."""
