"""What a policy is: anything that maps an observation to an action, in a file or not."""

from __future__ import annotations

import math
import textwrap
from abc import ABC, abstractmethod
from collections.abc import Sequence
from pathlib import Path
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from acsar_gym.errors import PolicyError
from acsar_gym.resources import AGENTS
from acsar_gym.sensors import Sensor
from acsar_gym.tasks import Observation, Task, signature
from acsar_gym.tasks.made import named

ENV_KEY = "acsar_gym.env"
LAYOUT_KEY = "acsar_gym.observation"
SCALE_KEY = "acsar_gym.scale"
RATE_KEY = "acsar_gym.policy_rate"
"""Keys of a file's metadata: the env's id, the names of the observation's numbers, what its
distances are divided by [m], and steps per second. Not every file has the last two."""


class Policy(Protocol):
    """Whatever maps an observation to an action."""

    def __call__(self, observation: Observation) -> NDArray[np.float32]:
        """The action for one observation; shapes as the env's spaces."""


class FilePolicy(ABC):
    """A policy that was read from a file."""

    path: Path
    env_id: str
    """The environment that it was trained for; empty where the file doesn't say."""
    env_named: bool = False
    """Whether the user has named the environment; otherwise the file does."""
    layout: str
    """What its observation consists of (see `tasks.signature`); empty where it doesn't say."""
    scale: float | None = None
    """What distances of its observation are divided by [m]; None where it doesn't say."""
    policy_rate: float | None = None
    """Decisions per second that it was trained for [Hz]; None where it doesn't say."""
    sha256: str | None = None
    """Of the bytes that were read from the file, as `sha256sum` prints it."""
    function: str | None = None
    """Which one of a Python file it is."""

    def check(
        self, task: Task, sensors: Sequence[Sensor], policy_rate: float | None = None
    ) -> None:
        """PolicyError where the policy was made for another observation than this env gives.

        And for another rate, where the env's `policy_rate` [Hz] is given.
        """
        wanted = signature(task, sensors)
        if self.layout and self.layout != wanted:
            raise PolicyError(
                f"{self.path}: made for {quoted(self.env_id)} and the observation "
                f"({quoted(self.layout)}), but {named(task)} gives ({wanted}): train it again, or "
                "choose its robot with --robot"
            )
        for name, own, given in (
            ("distances divided by", self.scale, scale_of(task)),
            ("a policy_rate of", self.policy_rate, policy_rate),
        ):
            if own is not None and given is not None and not math.isclose(own, given, rel_tol=1e-6):
                raise PolicyError(
                    f"{self.path}: made for {name} {own:g}, but this {named(task)} has {given:g}: "
                    "give the env the arguments that the policy was trained with"
                )

    @abstractmethod
    def __call__(self, observation: Observation) -> NDArray[np.float32]:
        """The deterministic action in [-1, 1], shape (2,), for one observation."""


def resolve(path: str | Path) -> Path:
    """The path itself, or the policy of that name that comes with the package."""
    path = Path(path)
    if path.exists():
        return path
    packaged = AGENTS / "policies" / f"{path}.onnx"
    if packaged.exists():
        return packaged
    known = ", ".join(sorted(p.stem for p in packaged.parent.glob("*.onnx"))) or "none"
    raise PolicyError(f"{path}: no such policy file; policies that come along: {known}")


def scale_of(task: Task) -> float | None:
    """What a task divides the distances by that it observes [m]; None where it doesn't say."""
    scale: float | None = getattr(task, "scale", getattr(task, "max_cross_track", None))
    return scale


def quoted(text: str) -> str:
    """What a file says, in one short line without control characters, for a message."""
    return textwrap.shorten(text.encode("unicode_escape").decode("ascii"), 300, placeholder="...")


def one_line(error: BaseException) -> str:
    """The kind of an exception and what it says, in one short line."""
    return textwrap.shorten(f"{type(error).__name__}: {quoted(str(error))}", 200)
