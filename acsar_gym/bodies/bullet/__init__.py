"""The skid-steer robot in PyBullet; importing it needs the `bullet` extra."""

from acsar_gym.bodies.bullet.body import BulletBody

__all__ = ["BulletBody"]
