"""Floor 2, odometry: frames to poses, and messages to messages. No clock, thread or file."""
