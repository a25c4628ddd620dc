"""Conditions of a benchmark: what may differ from a nominal robot on a nominal wire."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from acsar_gym.config import RobotConfig
from acsar_gym.dynamics.levels import level
from acsar_gym.errors import ConfigError, shown, suggestion
from acsar_gym.worlds.barn import ROBOT_RADIUS
from acsar_gym.worlds.search import footprint_radius

NOMINAL = "nominal"


@dataclass(frozen=True)
class Condition:
    """A robot and a wire under which agents drive."""

    words: str
    """What it is, for tables."""
    robot: str | None = None
    """Preset of the robot; None for the default."""
    changes: Mapping[str, Any] = field(default_factory=dict)
    """Fields of the robot's config that differ, as `RobotConfig.with_` takes them."""
    randomization: int = 0
    """Level of `dynamics.levels`; 0 for none."""
    faults: Mapping[str, float] = field(default_factory=dict)
    """Faults of the wire; see `links.faults.Faults`."""
    difficulty: Mapping[str, float] = field(default_factory=dict)
    """Difficulty of a generator's worlds, for a robot that doesn't fit through harder ones."""

    @property
    def config(self) -> RobotConfig:
        """The robot."""
        return RobotConfig.of(self.robot).with_(**self.changes)

    def options(self, config: RobotConfig, source: str = "") -> dict[str, Any]:
        """Return the env's options besides the robot; those that change nothing are left out.

        Args:
            config: of the robot.
            source: generator of the worlds; "" for an open floor.
        """
        found: dict[str, Any] = {}
        if source in self.difficulty:
            found["difficulty"] = self.difficulty[source]
        if self.randomization:
            found["randomization"] = level(config, self.randomization)
        if self.faults:
            found["faults"] = dict(self.faults)
        return found

    def impossible(self, *, simulated: bool, published: bool) -> str:
        """Say why no agent can be measured under this condition; empty if one can.

        Args:
            simulated: whether the link is a simulation in this process.
            published: whether the worlds are the published ones of BARN, which are as they are.
        """
        if self.randomization and not simulated:
            return f"{self.words}: the emulated board's physics don't vary"
        radius = footprint_radius(self.config)
        if published and radius > ROBOT_RADIUS:
            return (
                f"{self.words}: the published worlds let a footprint of {ROBOT_RADIUS:.3g} m "
                f"radius through, this one has {radius:.3g} m"
            )
        return ""


CONDITIONS: dict[str, Condition] = {
    NOMINAL: Condition("as configured"),
    "randomization-1": Condition("half the randomization of training", randomization=1),
    "randomization-2": Condition("the randomization of training", randomization=2),
    "randomization-3": Condition("twice the randomization of training", randomization=3),
    "dropped-2": Condition("2 % of the lines lost", faults={"dropped_lines": 0.02}),
    "dropped-5": Condition("5 % of the lines lost", faults={"dropped_lines": 0.05}),
    "level-2-dropped-2": Condition(
        "randomization of training, 2 % of the lines lost",
        randomization=2,
        faults={"dropped_lines": 0.02},
    ),
    "late-lines": Condition("5 % of the lines 50 ms late", faults={"late_lines": 0.05}),
    "scan-dropouts": Condition(
        "10 % of the rays without echo", changes={"lidar": {"dropouts": 0.1}}
    ),
    "feedback-30": Condition("30 Hz feedback", changes={"firmware": {"feedback_rate": 30.0}}),
    "feedback-20": Condition("20 Hz feedback", changes={"firmware": {"feedback_rate": 20.0}}),
    "baud-38400": Condition("38400 baud", changes={"baud_rate": 38400}),
    "command-delay": Condition(
        "commands work 50 ms later", changes={"firmware": {"command_delay": 0.05}}
    ),
    "husky": Condition(
        "a robot like a Husky, in Barn at difficulty 0.2", robot="husky", difficulty={"barn": 0.2}
    ),
    "jackal": Condition("a robot like a Jackal", robot="jackal"),
}
"""Conditions by name. Robots of another size drive in worlds of the same numbers, made for their
footprint. A Husky is wider than the gaps of most BARN worlds: only those of the least filled fields
(difficulty below 0.25) can be made for it."""


def chosen(names: Sequence[str]) -> tuple[str, ...]:
    """Check names of conditions; ConfigError suggests the right one for an unknown one."""
    for name in names:
        if name not in CONDITIONS:
            raise ConfigError(f"--conditions {shown(name)}{suggestion(name[:40], CONDITIONS)}")
    return tuple(dict.fromkeys(names))
