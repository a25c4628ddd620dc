"""Bodies: a simulated chassis, in PyBullet or planar.

Both use the motor and tyre model of `dynamics`.
"""

from acsar_gym.bodies.base import Body, GroundTruth

__all__ = ["Body", "GroundTruth"]
