"""The live nodes on ROS 2: wiring alone; nothing here can be imported without rclpy."""
