"""Trained policies as single ONNX files: what drives a robot needs no torch."""

from __future__ import annotations

from abc import ABC, abstractmethod
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from acsar_gym.config import RobotConfig
from acsar_gym.errors import MissingExtraError, PolicyError
from acsar_gym.resources import AGENTS
from acsar_gym.tasks import Observation, Task, signature

ENV_KEY = "acsar_gym.env"
LAYOUT_KEY = "acsar_gym.observation"
"""Keys of the file's metadata: the env's id, and the names of the observation's numbers."""


class Policy(Protocol):
    """Whatever maps an observation to an action."""

    def __call__(self, observation: Observation) -> NDArray[np.float32]:
        """The action for one observation; shapes as the env's spaces."""


class FilePolicy(ABC):
    """A policy that was read from a file."""

    path: Path
    env_id: str
    """The environment that it was trained for; empty where the file doesn't say."""
    layout: str
    """What its observation consists of (see `tasks.signature`); empty where it doesn't say."""

    def check(self, task: Task, config: RobotConfig) -> None:
        """PolicyError where the policy was made for another observation than this env gives."""
        wanted = signature(task, config)
        if self.layout and self.layout != wanted:
            raise PolicyError(
                f"{self.path}: made for {self.env_id} and the observation ({self.layout}), but "
                f"{task.id} gives ({wanted}): train it again, or choose its robot with --robot"
            )

    @abstractmethod
    def __call__(self, observation: Observation) -> NDArray[np.float32]:
        """The deterministic action in [-1, 1], shape (2,), for one observation."""


class OnnxPolicy(FilePolicy):
    """A policy read from an ONNX file; loading runs no code from the file.

    Raises PolicyError where the file is missing or isn't a policy of this package, and
    MissingExtraError without onnxruntime.
    """

    def __init__(self, path: str | Path) -> None:
        self.path = resolve(path)
        try:
            import onnxruntime  # noqa: PLC0415 - optional
        except ImportError:
            raise MissingExtraError("running a policy", "deploy") from None
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = options.inter_op_num_threads = 1
        options.log_severity_level = 4
        try:
            self._session: Any = onnxruntime.InferenceSession(
                self.path.read_bytes(), options, providers=["CPUExecutionProvider"]
            )
        except OSError as error:
            raise PolicyError(f"{self.path}: can't be read: {error}") from None
        except Exception as error:  # noqa: BLE001 - onnxruntime's errors have no common base of their own
            raise PolicyError(f"{self.path}: not an ONNX policy: {error}") from None
        self._check()

    def _check(self) -> None:
        names = [[put.name for put in self._session.get_inputs()]]
        names.append([put.name for put in self._session.get_outputs()])
        if names != [["observation"], ["action"]]:
            raise PolicyError(f"{self.path}: must map 'observation' to 'action', maps {names}")
        metadata = self._session.get_modelmeta().custom_metadata_map
        self.env_id = metadata.get(ENV_KEY, "")
        self.layout = metadata.get(LAYOUT_KEY, "")
        # "module:id" would have Gymnasium import a module because the file says so.
        if not self.env_id or ":" in self.env_id or not self.layout:
            raise PolicyError(
                f"{self.path}: doesn't say which environment it is for: export it with sb3.export"
            )

    def __call__(self, observation: Observation) -> NDArray[np.float32]:
        """The deterministic action in [-1, 1], shape (2,), for one observation."""
        action: NDArray[np.float32] = self._session.run(None, {"observation": observation[None]})[
            0
        ][0]
        return action


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
