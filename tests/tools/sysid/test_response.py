"""The answer that is fitted is that of the twin."""

from __future__ import annotations

import math

import numpy as np
import pytest

from acsar_gym import RobotConfig
from acsar_gym.physics.model import ramp_set_points
from acsar_gym.physics.planar import PlanarBody
from acsar_gym.tools.sysid.response import Rounding, simulate_speeds

FINE = RobotConfig(
    motor={"time_constant": 0.1, "gain": 0.95, "deadband": 0.5, "acceleration": 40.0},
    encoder={"counts_per_revolution": 10_000_000},
)


def test_simulate_speeds_is_the_twin_loop_for_loop() -> None:
    """If commands come at its loops, only the encoder's floor differs."""
    body = PlanarBody(FINE)
    dt = 0.005
    commands = np.repeat(np.random.default_rng(1).uniform(-12.0, 12.0, 20), 30)
    speeds = simulate_speeds(
        (np.append(0.0, commands[:-1]), commands, np.ones(len(commands))),
        step=40.0 * dt,
        blend=1.0 - math.exp(-dt / 0.1),
        gain=0.95,
        deadband=0.5,
        top=30.0,
        spread=0.0,
    )

    expected = []
    points = (0.0, 0.0, 0.0, 0.0)
    for command in commands:
        points = ramp_set_points(points, (command,) * 4, (40.0 * dt,) * 4)
        body.step(points)
        expected.append(body.wheel_speeds[0])
    assert speeds == pytest.approx(np.array(expected), abs=1e-9)


def test_rounding_rounds_or_cuts_coarse_steps() -> None:
    speeds = np.array([0.2, 0.7, -1.2, -1.8])
    assert Rounding(0.05).apply(speeds) == pytest.approx(speeds)
    assert Rounding(1.0).apply(speeds) == pytest.approx([0.0, 1.0, -1.0, -2.0])
    assert Rounding(1.0, is_cut=True).apply(speeds) == pytest.approx([0.0, 0.0, -1.0, -1.0])
