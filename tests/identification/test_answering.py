"""Miswired wheels are told from their answers; logs in which wheels move together aren't blamed."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from acsar_gym import RobotConfig, open_link
from acsar_gym.errors import IdentificationError
from acsar_gym.robot import Robot
from acsar_gym.tools.sysid import identifiability
from acsar_gym.tools.sysid.excitation import TappedLink, plan_excitation
from acsar_gym.tools.sysid.tracks import BoardTrack, decode_track

ACSAR = RobotConfig.preset("acsar")
SLOW = {
    "motor": {"time_constant": 0.3, "deadband": 1.0},
    "firmware": {"feedback_rate": 20.0, "command_delay": 0.04},
}


def driven(commands: Any, **hidden: Any) -> list[BoardTrack]:
    """Drive a hidden robot with these wheel speeds."""
    tapped = TappedLink(open_link("planar", ACSAR.with_(**hidden)))
    with Robot(tapped, ACSAR) as robot:
        for speeds in commands:
            robot.tick(speeds)
    found = decode_track(tapped.log, ACSAR)
    assert found is not None
    return [found]


def steps() -> Any:
    """Five seconds of a manoeuvre."""
    return plan_excitation(ACSAR, 12.0, 0.01).before[:500].tolist()


@pytest.mark.parametrize(
    ("wheels", "said"),
    [
        ({"a": {"motor": "b"}, "b": {"motor": "a"}}, "front_right answers front_left's command:"),
        ({"c": {"encoder": "d"}, "d": {"encoder": "c"}}, "rear_left answers rear_right's command:"),
        ({"b": {"sign": -1}}, "front_left turns backward at forward commands"),
        ({"d": {"motor_sign": -1}}, "rear_right turns backward at forward commands"),
        (
            {"a": {"motor": "b", "motor_sign": -1}, "b": {"motor": "a"}},
            "front_right answers front_left's command",
        ),
    ],
)
def test_a_miswired_wheel_is_named(wheels: Any, said: str) -> None:
    with pytest.raises(IdentificationError, match=said):
        identifiability.check_wheel_order(driven(steps(), wheels=wheels))


@pytest.mark.parametrize("hidden", [{}, SLOW], ids=["usual", "slow"])
@pytest.mark.parametrize("pattern", [(1, 1, 1, 1), (1, -1, -1, 1), None])
def test_a_robot_that_is_wired_right_is_not_blamed(pattern: Any, hidden: Any) -> None:
    if pattern is None:
        identifiability.check_wheel_order(driven(steps(), **hidden))
        return
    waves = 5.0 * np.sin(np.arange(500)[:, None] / 20.0) * pattern
    identifiability.check_wheel_order(driven(waves.tolist(), **hidden))


def test_a_dead_wheel_is_not_miswired() -> None:
    identifiability.check_wheel_order(driven(steps(), motor={"deadband": (0.0, 20.0, 0.0, 0.0)}))
