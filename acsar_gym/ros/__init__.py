"""ROS 2: nodes, and what its messages mean."""
