"""Fleets: what makes one, and what all of its robots must share."""

from __future__ import annotations

from typing import Any

import pytest

from acsar_gym import RobotConfig
from acsar_gym.config.fleet import make_fleet
from acsar_gym.errors import ConfigError

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
def test_a_fleet_is_a_robot_a_list_or_a_range(source: Any, names: list[str]) -> None:
    fleet = make_fleet(source)
    assert list(fleet.names) == names
    assert len(fleet.robots) == len(names)


@pytest.mark.parametrize(
    ("source", "said"),
    [
        ([], "a fleet of 0 robots: must have 1 to 10,000"),
        ("0xjackal", "a fleet of 0 robots"),
        (["acsar", "husk"], "unknown robot preset 'husk'"),
        (["acsar", ["jackal"]], "give one robot here"),
        (
            ["jackal", ACSAR.with_(control_rate=50.0)],
            "robot: jackal has control_rate = 100.0, number 1 50.0: must be the same",
        ),
        (
            [ACSAR, ACSAR.with_(firmware={"loop_rate": 400.0})],
            "number 0 has firmware.loop_rate = 200.0, number 1 400.0",
        ),
    ],
)
def test_what_cannot_be_a_fleet_is_refused(source: Any, said: str) -> None:
    with pytest.raises(ConfigError, match=said):
        make_fleet(source)
