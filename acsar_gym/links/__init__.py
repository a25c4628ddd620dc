"""Links: connections to a robot, real or simulated, chosen by name or device path."""

from acsar_gym.links.base import Link
from acsar_gym.links.factory import open_link

__all__ = ["Link", "open_link"]
