"""Logs of messages: MCAP and ROS bags, in Foxglove's and ROS's schemas."""
