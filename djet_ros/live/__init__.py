"""What both live faces share, without ROS or DDS: sessions, their queue, topics, wiring."""
