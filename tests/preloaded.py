"""What emulators import and compile, done once for all programs of processes.py."""

from __future__ import annotations

import boards
import lidar_tools

from acsar_gym import RobotConfig, open_link
from acsar_gym.tools import cli
from acsar_gym.tools.emulation import board as emulator
from acsar_gym.worlds import Scene, pool

__all__ = ["boards", "cli", "emulator", "lidar_tools", "pool"]

link = open_link("planar", RobotConfig.preset("acsar"))
link.open()
link.reset(Scene())
link.advance(0.01)
link.close()
