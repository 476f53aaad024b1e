"""The live nodes on ROS 2 (rclpy), and what their launch files share."""
