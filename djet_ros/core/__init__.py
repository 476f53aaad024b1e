"""Images and matrices in, frozen results out: features, matches, surfaces, JET. No ROS, no files."""
