"""Boards with quirks in simulated time, for tests of the doctor."""

from __future__ import annotations

from functools import partial

from acsar_gym import RobotConfig
from acsar_gym.bodies.planar import PlanarBody
from acsar_gym.doctor import wire
from acsar_gym.doctor.checks import Check
from acsar_gym.doctor.commission import Commission
from acsar_gym.emulation import quirks
from acsar_gym.links.simulated import SimulatedLink


def board(*names: str, robot: RobotConfig | None = None) -> quirks.QuirkyLink:
    """A board in simulated time that behaves so, with the robot's own parameters."""
    found = quirks.parsed(names)
    config = quirks.of_config(found, robot or RobotConfig())
    link = SimulatedLink(config, partial(PlanarBody, config))
    link.open()
    return quirks.QuirkyLink(link, config, found)


def commissioned(
    link: quirks.QuirkyLink, commission: Commission, config: RobotConfig | None = None
) -> dict[str, Check]:
    """The doctor's findings, by name; the robot is taken to be the usual one."""
    found = wire.examined(link, config or RobotConfig(), commission)
    return {check.name: check for check in found}
