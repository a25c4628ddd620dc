"""Trained policies as single ONNX files, which run without torch."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from acsar_gym.errors import MissingExtraError, PolicyError
from acsar_gym.policies import graph, limits, trial
from acsar_gym.policies.base import (
    ENV_KEY,
    LAYOUT_KEY,
    RATE_KEY,
    SCALE_KEY,
    FilePolicy,
    one_line,
    quoted,
    resolve,
)
from acsar_gym.reading import bounded
from acsar_gym.sensors import Sensor
from acsar_gym.tasks import Observation, Task
from acsar_gym.tasks.made import named
from acsar_gym.tasks.spaces import task_spaces

MAX_BYTES = 32_000_000
"""Largest accepted file [bytes]; 8 million float32 weights."""


class OnnxPolicy(FilePolicy):
    """A policy read from an ONNX file; loading runs no code from the file.

    The cost of running it is checked first: its graph, and, unless it is a plain chain of dense
    layers, one decision in a subprocess with limits of memory and CPU time.

    Args:
        path: an ONNX file, or the name of a policy that comes with the package.

    Raises:
        PolicyError: the file is missing, or isn't a policy that this package accepts.
        MissingExtraError: onnxruntime isn't installed.
    """

    def __init__(self, path: str | Path) -> None:
        self.path = resolve(path)
        try:
            import onnxruntime  # noqa: F401, PLC0415 - optional
        except ImportError:
            raise MissingExtraError("running a policy", "deploy") from None
        data = bounded.read(self.path, MAX_BYTES, PolicyError)
        self.sha256 = hashlib.sha256(data).hexdigest()
        try:
            network = inspected(data)
            self.scale, self.policy_rate = (_number(network, key) for key in (SCALE_KEY, RATE_KEY))
            tried = limits.plain(network) or trial.refusal(data, network.width)
        except PolicyError as error:
            raise PolicyError(f"{self.path}: {error}") from None
        if isinstance(tried, str) and tried:
            raise PolicyError(f"{self.path}: not a policy to run: {tried}")
        self.env_id, self.layout = (network.metadata[key] for key in (ENV_KEY, LAYOUT_KEY))
        self.width = network.width
        self._session = self._started(data)

    def _started(self, data: bytes) -> Any:
        """Start an onnxruntime session, after a trial in a subprocess unless the graph is plain."""
        try:
            session = trial.session(data)
            trial.decide(session, self.width)
        except Exception as error:  # noqa: BLE001 - onnxruntime's errors have no common base of their own
            raise PolicyError(f"{self.path}: not an ONNX policy: {one_line(error)}") from None
        return session

    def check(
        self, task: Task, sensors: Sequence[Sensor], policy_rate: float | None = None
    ) -> None:
        """As FilePolicy.check; also compares the size of the observation.

        Raises:
            PolicyError: the policy was made for another observation than this env gives.
        """
        super().check(task, sensors, policy_rate)
        wanted = (task_spaces(task, sensors)[1].shape or (0,))[0]
        if self.width != wanted:
            raise PolicyError(
                f"{self.path}: takes {self.width} numbers, but {named(task)} gives {wanted}"
            )

    def __call__(self, observation: Observation) -> NDArray[np.float32]:
        """Compute the deterministic action in [-1, 1], shape (2,), for one observation."""
        action: NDArray[np.float32] = self._session.run(None, {"observation": observation[None]})[
            0
        ][0]
        return action


def _number(network: graph.Graph, key: str) -> float | None:
    """Read a number from the metadata; None if the key is missing."""
    said = network.metadata.get(key)
    try:
        number = None if said is None else float(said)
    except ValueError:
        number = math.nan
    if number is not None and not 0.0 < number < math.inf:
        raise PolicyError(f"{key} = {quoted(str(said))}: must be a positive number")
    return number


def inspected(data: bytes) -> graph.Graph:
    """Parse and check the content of an ONNX file.

    Returns:
        The network, if it is acceptable as a policy.

    Raises:
        PolicyError: it isn't; the message doesn't name the file.
    """
    network = graph.read(data)
    limits.check(network)
    env_id, layout = (network.metadata.get(key, "") for key in (ENV_KEY, LAYOUT_KEY))
    # With "module:id", Gymnasium would import a module that the file chooses.
    if not env_id or ":" in env_id or not layout:
        raise PolicyError(
            "doesn't say which environment it is for: write it with 'acsar-gym export' or "
            "acsar_gym.policies.save"
        )
    return network
