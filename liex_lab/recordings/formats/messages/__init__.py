"""Logs of time-stamped messages on topics: MCAP and ROS bags, in Foxglove's and ROS's schemas."""
