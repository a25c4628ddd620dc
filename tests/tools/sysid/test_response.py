"""The answer that is fitted is that of the twin."""

from __future__ import annotations

import numpy as np
import pytest

from acsar_gym import RobotConfig, open_link
from acsar_gym.tools.sysid.board_log import decode_tracks
from acsar_gym.tools.sysid.excitation import drive_excitation
from acsar_gym.tools.sysid.response import (
    BoardModel,
    Responder,
    Rounding,
    WheelModel,
    lag_blend,
    ramp_step,
    simulate_speeds,
)

BASE = RobotConfig.preset("acsar")
FINE = BASE.with_(
    motor={"time_constant": 0.1, "gain": 0.95, "deadband": 0.5, "acceleration": 40.0},
    encoder={"counts_per_revolution": 10_000_000},
    firmware={"feedback_rate": 50.0, "command_delay": 0.01},
)


def test_speeds_are_those_of_the_twin() -> None:
    """Loop for loop, where commands come at its loops: only the encoder's floor differs."""
    from acsar_gym.physics.model import ramp_set_points
    from acsar_gym.physics.planar import PlanarBody

    body, dt = PlanarBody(FINE), 0.005
    rng = np.random.default_rng(1)
    commands = np.repeat(rng.uniform(-12.0, 12.0, 20), 30)
    share = np.ones(len(commands))
    heard = (np.concatenate(([0.0], commands[:-1])), commands, share)
    ours = simulate_speeds(
        heard, ramp_step(1.0 / 40.0, dt), lag_blend(0.1, dt), 0.95, 0.5, 30.0, 0.0
    )
    theirs, points = [], (0.0, 0.0, 0.0, 0.0)
    for command in commands:
        points = ramp_set_points(points, (command,) * 4, (40.0 * dt,) * 4)
        body.step(points)
        theirs.append(body.wheel_speeds[0])
    assert ours == pytest.approx(np.array(theirs), abs=1e-9)


def test_the_answer_predicts_what_the_twin_prints() -> None:
    """Over the wire, at any phase: within the twin's loops, which the answer averages over."""
    log = drive_excitation(open_link("planar", FINE), BASE, 12.0)
    (track,) = decode_tracks([log], BASE)
    responder = Responder(1.0 / BASE.firmware.loop_rate, BASE.motor.max_speed, Rounding())
    motor = WheelModel(0.1, 0.95, 1.0 / 40.0, 0.5)
    for wheel in range(4):
        rest = responder.residuals([track], wheel, motor, BoardModel(0.01, 0.05, 0.5))
        assert np.sqrt(np.mean(rest**2)) < 0.06
        late = responder.residuals([track], wheel, motor, BoardModel(0.02, 0.05, 0.5))
        assert np.mean(late**2) > 4.0 * np.mean(rest**2)


def test_coarse_steps_are_rounded_or_cut() -> None:
    speeds = np.array([0.2, 0.7, -1.2, -1.8])
    assert Rounding(0.05).apply(speeds) == pytest.approx(speeds)
    assert Rounding(1.0).apply(speeds) == pytest.approx([0.0, 1.0, -1.0, -2.0])
    assert Rounding(1.0, is_cut=True).apply(speeds) == pytest.approx([0.0, 0.0, -1.0, -1.0])
