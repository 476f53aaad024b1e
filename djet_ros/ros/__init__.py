"""The live nodes on rclpy: wiring alone. All that needs a ROS 2 installation is here."""
