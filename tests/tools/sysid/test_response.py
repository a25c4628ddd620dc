"""The answer that is fitted is that of the twin."""

from __future__ import annotations

import math

import numpy as np
import pytest

from acsar_gym import RobotConfig, open_link
from acsar_gym.physics.model import ramp_set_points
from acsar_gym.physics.planar import PlanarBody
from acsar_gym.tools.sysid.board_log import decode_tracks
from acsar_gym.tools.sysid.excitation import drive_excitation
from acsar_gym.tools.sysid.response import (
    BoardModel,
    Responder,
    Rounding,
    WheelModel,
    simulate_speeds,
)

BASE = RobotConfig.preset("acsar")
FINE = BASE.with_(
    motor={"time_constant": 0.1, "gain": 0.95, "deadband": 0.5, "acceleration": 40.0},
    encoder={"counts_per_revolution": 10_000_000},
    firmware={"feedback_rate": 50.0, "command_delay": 0.01},
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


def test_responder_predicts_what_the_twin_prints() -> None:
    """Over the wire, at any phase: within the twin's loops, which the answer averages over."""
    log = drive_excitation(open_link("planar", FINE), BASE, 12.0)
    tracks = decode_tracks([log], BASE)
    responder = Responder(tracks, 1.0 / BASE.firmware.loop_rate, BASE.motor.max_speed, Rounding())
    motor = WheelModel(0.1, 0.95, 1.0 / 40.0, 0.5)
    for wheel in range(4):
        errors, late_errors = (
            responder.answers(wheel, motor, BoardModel(delay, 0.05, 0.5))
            - tracks[0].speeds[:, wheel]
            for delay in (0.01, 0.02)
        )
        assert np.sqrt(np.mean(errors**2)) < 0.06
        assert np.mean(late_errors**2) > 4.0 * np.mean(errors**2)


def test_rounding_rounds_or_cuts_coarse_steps() -> None:
    speeds = np.array([0.2, 0.7, -1.2, -1.8])
    assert Rounding(0.05).apply(speeds) == pytest.approx(speeds)
    assert Rounding(1.0).apply(speeds) == pytest.approx([0.0, 1.0, -1.0, -2.0])
    assert Rounding(1.0, is_cut=True).apply(speeds) == pytest.approx([0.0, 0.0, -1.0, -1.0])
