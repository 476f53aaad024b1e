"""The odometry on a ROS 2 graph without ROS: its topics are DDS topics, by Eclipse Cyclone DDS."""
