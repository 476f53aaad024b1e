"""The live odometry on Eclipse Cyclone DDS, without ROS: wiring alone."""
