"""The interface of a policy, and the base class of policies that are loaded from files."""

from __future__ import annotations

import textwrap
from abc import ABC, abstractmethod
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Protocol

import numpy as np
from numpy.typing import NDArray

from acsar_gym.config import RobotConfig
from acsar_gym.errors import PolicyError
from acsar_gym.policies import matching
from acsar_gym.policies.bundle import Bundle
from acsar_gym.resources import AGENTS
from acsar_gym.sensors import Sensor
from acsar_gym.tasks import Observation, Task

if TYPE_CHECKING:
    from acsar_gym.envs.base import RobotEnv


class Policy(Protocol):
    """A callable that maps one observation to one action."""

    def __call__(self, observation: Observation) -> NDArray[np.float32]:
        """Choose the action for one observation.

        Args:
            observation: float32, shape and range of the env's observation space.

        Returns:
            The action, shape (2,), within the env's action space.
        """


class FilePolicy(ABC):
    """Base class of the policies that are loaded from a file."""

    path: Path
    env_id: str
    """Id of the env that it was trained for; empty if the file doesn't name one."""
    env_named: bool = False
    """Whether `env_id` was given by the user (True) or by the file (False)."""
    bundle: Bundle | None = None
    """What the file says about the policy; None if it can't hold that, as Python code."""
    differences: tuple[str, ...] = ()
    """How the robot of the last `check` differs from those of the training, a line each."""
    sha256: str | None = None
    """SHA-256 of the file's content, in hexadecimal as `sha256sum` prints it."""
    function: str | None = None
    """Name of the function, if the file is a Python file."""

    @property
    def about(self) -> dict[str, str | None]:
        """What headers of results and recordings say about it."""
        return {
            "file": str(self.path),
            "sha256": self.sha256,
            "function": self.function,
            "env": self.env_id,
        }

    def check(
        self,
        task: Task,
        sensors: Sequence[Sensor],
        policy_rate: float | None = None,
        config: RobotConfig | None = None,
    ) -> None:
        """Check that the policy can drive in an env; `differences` has how its robot differs.

        A policy without a bundle fits every env.

        Args:
            task: task of the env.
            sensors: sensors of the env, in the order of the observation.
            policy_rate: policy steps per second of the env [Hz]; None to skip this check.
            config: of the robot; None to skip what depends on it.

        Raises:
            PolicyError: names the first field that doesn't match; see `matching`.
        """
        if self.bundle is None:
            return
        try:
            matching.check(self.bundle, task, sensors, config, policy_rate)
        except PolicyError as error:
            raise PolicyError(f"{self.path}: {error}") from None
        if config is not None:
            self.differences = tuple(matching.differences(self.bundle, sensors, config))

    @property
    def scale(self) -> float | None:
        """Length that distances in its observation are divided by [m]; None if unknown."""
        return None if self.bundle is None else self.bundle.observation.scale

    def bind(self, env: RobotEnv) -> None:  # noqa: B027 - most policies need nothing of it
        """Take what the policy needs of the env that it will drive; by default nothing.

        Args:
            env: made and checked for this policy, not reset yet.
        """

    def reset(self) -> None:  # noqa: B027 - most policies have no memory
        """Begin an episode, right after the env's reset; by default nothing changes."""

    @abstractmethod
    def __call__(self, observation: Observation) -> NDArray[np.float32]:
        """Compute the deterministic action for one observation.

        Args:
            observation: float32, shape of the env's observation space.

        Returns:
            The action in [-1, 1], float32, shape (2,).
        """


def resolve(path: str | Path, baselines: Iterable[str] = ()) -> Path:
    """Find a policy file.

    Args:
        path: a file, or the name of a policy that comes with the package, such as "point_goal".
        baselines: names that the error tells, beside those of the packaged policies.

    Returns:
        Path of an existing file.

    Raises:
        PolicyError: there is neither a file nor a packaged policy of that name.
    """
    path = Path(path)
    if path.exists():
        return path
    packaged = AGENTS / "policies" / f"{path}.onnx"
    if packaged.exists():
        return packaged
    known = ", ".join(sorted(p.stem for p in packaged.parent.glob("*.onnx"))) or "none"
    others = f"; baselines: {', '.join(baselines)}" if baselines else ""
    raise PolicyError(f"{path}: no such policy file; policies that come along: {known}{others}")


def quoted(text: str) -> str:
    """Shorten text from a file to one line with escaped control characters, for messages."""
    return textwrap.shorten(text.encode("unicode_escape").decode("ascii"), 300, placeholder="...")


def one_line(error: BaseException) -> str:
    """Format an exception as one short line: its type and its message."""
    return textwrap.shorten(f"{type(error).__name__}: {quoted(str(error))}", 200)
