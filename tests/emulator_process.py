"""What processes that emulate devices import and compile, done once for all of them.

serial_tools.py has them forked from one that imports this: a second of CPU less for each.
"""

from __future__ import annotations

from acsar_gym import RobotConfig, open_link
from acsar_gym.tools import cli
from acsar_gym.tools.emulation import board as emulator
from acsar_gym.worlds import Scene, pool

__all__ = ["cli", "emulator", "pool"]

link = open_link("planar", RobotConfig.preset("acsar"))
link.open()
link.reset(Scene())
link.advance(0.01)
link.close()
