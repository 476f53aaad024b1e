"""What needs a ROS 2 installation."""
