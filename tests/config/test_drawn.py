"""Robots drawn at random: the same everywhere, and such as can be built. Fleets of robots."""

from __future__ import annotations

import hashlib
import json
from typing import Any

import pytest

from acsar_gym import RobotConfig
from acsar_gym.config import drawn
from acsar_gym.config.fleet import make_fleet
from acsar_gym.config.robot import hash_config
from acsar_gym.errors import ConfigError

FIRST = [RobotConfig.of(f"drawn:{number}") for number in range(128)]


def test_drawn_number_is_always_the_same_robot() -> None:
    """On every machine, so that the hash is always this robot."""
    assert RobotConfig.of("drawn:17") == FIRST[17]
    text = json.dumps([drawn.draw_robot(number) for number in range(20)])
    assert hashlib.sha256(text.encode()).hexdigest()[:16] == "ef8d842fb126c273"
    assert len({hash_config(robot) for robot in FIRST}) == len(FIRST)


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("drawn:1-", "must be like"),
        ("drawn:5-3", "holds no robot"),
        ("drawn:train", ".* give one robot here, such as 'drawn:0'"),
    ],
)
def test_drawn_name_that_is_no_robot_is_refused(text: str, reason: str) -> None:
    with pytest.raises(ConfigError, match=f"^robot = '{text}': {reason}"):
        RobotConfig.of(text)


ACSAR = RobotConfig.preset("acsar")


@pytest.mark.parametrize(
    ("source", "names"),
    [
        (None, ["number 0"]),
        (["acsar", ACSAR, {"name": "mine"}], ["acsar", "number 1", "number 2"]),
        ("drawn:7-9", ["drawn:7", "drawn:8", "drawn:9"]),
        ("drawn:4-4,husky", ["drawn:4", "husky"]),
        ("2xjackal,husky,2xdrawn:4-5", ["jackal", "jackal", "husky", *["drawn:4", "drawn:5"] * 2]),
    ],
)
def test_make_fleet_takes_a_robot_a_list_or_a_range(source: Any, names: list[str]) -> None:
    fleet = make_fleet(source)
    assert list(fleet.names) == names
    assert len(fleet.robots) == len(names)


@pytest.mark.parametrize(
    ("source", "said"),
    [
        ([], "a fleet of 0 robots: must have 1 to 10,000"),
        ("acsar,drawn:0-999999999", "a fleet of 1,000,000,000 robots: must have 1 to 10,000"),
        (
            ["jackal", ACSAR.with_(control_rate=50.0)],
            "robot: jackal has control_rate = 100.0, number 1 50.0: must be the same",
        ),
    ],
)
def test_make_fleet_refuses_what_cannot_be_a_fleet(source: Any, said: str) -> None:
    with pytest.raises(ConfigError, match=said):
        make_fleet(source)
