"""How far a robot's twin is from the robot: reports on recordings of both."""
