"""Frames to a trajectory, and messages to messages. No clock, thread, socket or file."""
