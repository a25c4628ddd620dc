"""Where a robot drives: scenes, in the world frame of REP 105 (x, y [m], theta [rad])."""

from acsar_gym.worlds.scene import Pose, Scene

__all__ = ["Pose", "Scene"]
