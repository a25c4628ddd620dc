"""Bodies: what the wheels carry. PyBullet's robot and the planar one share `dynamics.py`."""

from acsar_gym.bodies.base import Body, GroundTruth

__all__ = ["Body", "GroundTruth"]
