"""Nodes of ROS 2: a robot behind any link as ROS sees robots, and a policy that drives one."""
