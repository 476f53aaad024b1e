"""The live nodes on Eclipse Cyclone DDS, without ROS, and a bag player."""
