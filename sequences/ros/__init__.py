"""Bags of ROS 1 and ROS 2, MCAP files, and RealSense bags."""
