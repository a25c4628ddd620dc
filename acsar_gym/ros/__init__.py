"""ROS 2, live: the one door to rclpy, and what its messages mean."""
