"""Links: the wire's other side, chosen by a name or a device path."""

from acsar_gym.links.base import Link
from acsar_gym.links.factory import open_link

__all__ = ["Link", "open_link"]
