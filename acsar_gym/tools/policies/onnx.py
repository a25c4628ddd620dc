"""Policies as single ONNX files, which run without torch."""

from __future__ import annotations

import hashlib
import math
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from acsar_gym import reading
from acsar_gym.config import RobotConfig
from acsar_gym.errors import MissingExtraError, PolicyError, format_error
from acsar_gym.sensors import Sensor
from acsar_gym.tasks import Observation, Task
from acsar_gym.tools.policies import document as documents
from acsar_gym.tools.policies.document import PolicyDocument
from acsar_gym.tools.policies.policy import Actions, FilePolicy, resolve

# onnxruntime 1.29 and later read this when they are imported. Without it they report to their maker
# what they run, and keep an id of this computer in the user's cache folder.
os.environ.setdefault("ORT_DISABLE_TELEMETRY", "1")

MAX_POLICY_BYTES = 32_000_000
"""Largest accepted ONNX file [bytes], 8 million float32 weights."""
MAX_STATE_SIZE = 1_000_000
"""Most numbers of a recurrent state."""
EXTERNAL_DATA = b"\n\x08location\x12"
"""How protobuf writes the key of a tensor's place in another file."""


class OnnxPolicy(FilePolicy):
    """A policy read from an ONNX file. Loading runs no code from the file.

    The network maps `observation` (batch, n) to `action` (batch, 2). Each further input is a
    recurrent state, whose next value is the output at the same place. All states are zeros at the
    start of an episode. A policy can be pickled, with its file's content.

    Args:
        path: An ONNX file, or the name of a packaged policy.

    Raises:
        PolicyError: The file is missing, or isn't a policy that this package accepts.
        MissingExtraError: onnxruntime isn't installed.

    Example:
        import numpy as np
        from acsar_gym.tools.policies import OnnxPolicy

        policy = OnnxPolicy("point_goal")
        assert policy(np.zeros(7, np.float32)).shape == (2,)
    """

    document: PolicyDocument
    """What the file contains besides the network."""

    def __init__(self, path: str | Path) -> None:
        self.path = resolve(path)
        content = reading.read_file(self.path, MAX_POLICY_BYTES, PolicyError)
        self.sha256 = hashlib.sha256(content).hexdigest()
        self._load(content)
        self.env_id = self.document.env

    def _load(self, content: bytes) -> None:
        """Load the network, and decide once on zeros."""
        # A session can't be pickled, so the content is kept to load it again.
        self._content = content
        try:
            self._session = _load_session(content)
            metadata = self._session.get_modelmeta().custom_metadata_map
            self.document = documents.parse_document(metadata)
            self._check_network()
        except PolicyError as error:
            raise PolicyError(f"{self.path}: {error}") from error

        self.width = self.document.width
        self.scale = self.document.scale
        self.reset()
        # A file of another exporter may be fixed to one observation.
        has_free_batch = isinstance(self._session.get_inputs()[0].shape[0], str)
        if has_free_batch and not self._states:
            self.act_many = self._act_many

    def __getstate__(self) -> dict[str, Any]:
        """Return what is pickled: the content of the file instead of the session."""
        unpicklable = ("_session", "act_many")
        return {name: value for name, value in vars(self).items() if name not in unpicklable}

    def __setstate__(self, state: dict[str, Any]) -> None:
        vars(self).update(state)
        self._load(self._content)

    def _check_network(self) -> None:
        """Find the states, and check that an observation of zeros gets the same action twice."""
        inputs = self._session.get_inputs()
        outputs = self._session.get_outputs()
        names = [value.name for value in (*inputs[:1], outputs[0])]
        if names != ["observation", "action"]:
            raise PolicyError(f"must map 'observation' to 'action', not {str(names)[:80]}")
        if any(value.type != "tensor(float)" for value in (*inputs, *outputs)):
            raise PolicyError("must have inputs and outputs of float32")
        states = inputs[1:]
        for state in states:
            is_fixed = all(isinstance(size, int) for size in state.shape)
            if not is_fixed or math.prod(state.shape) > MAX_STATE_SIZE:
                shape = str(state.shape)[:60]
                raise PolicyError(f"state {state.name[:40]} has shape {shape}: must be fixed")

        # Loading decides once, so that a driving robot meets no first error.
        self._zeros = {state.name: np.zeros(state.shape, np.float32) for state in states}
        zeros = {"observation": np.zeros((1, self.document.width), np.float32), **self._zeros}
        try:
            results = self._session.run(None, zeros)
            repeated = self._session.run(None, zeros)
        except Exception as error:  # onnxruntime's errors have no common base of their own
            raise PolicyError(
                f"doesn't decide for {self.document.width} numbers: {format_error(error)}"
            ) from error
        shapes = [result.shape for result in results]
        are_numbers = all(np.isfinite(result).all() for result in results)
        if shapes != [(1, 2), *(state.shape for state in self._zeros.values())] or not are_numbers:
            raise PolicyError(
                f"gives {str(results[0].tolist())[:100]} for zeros: must be (1, 2) finite float32 "
                "numbers, then the states that it takes"
            )
        if not np.array_equal(results[0], repeated[0]):
            raise PolicyError("decides at random: must give the same action for the same input")

    def check(
        self,
        task: Task,
        sensors: Sequence[Sensor],
        policy_rate: float | None = None,
        config: RobotConfig | None = None,
    ) -> None:
        """Check that the policy can drive in an env, and set `differences` and `outside`.

        Args:
            task: Task of the env.
            sensors: Sensors of the env, in the order of the observation.
            policy_rate: Policy steps per second of the env [Hz]. None to skip this check.
            config: Robot of the env. None to skip its comparison.

        Raises:
            PolicyError: Observation or rate differ. The message names the line.
        """
        try:
            documents.check_observation(self.document, task, sensors, policy_rate)
        except PolicyError as error:
            raise PolicyError(f"{self.path}: {error}") from error
        # These are warnings: the caller decides what real wheels may do.
        if config is not None:
            self.differences = tuple(documents.list_differences(self.document, task, config))
            self.outside = tuple(documents.list_outside(self.document, config))

    def save(self, path: Path) -> None:
        """Write the policy to an ONNX file, all of it or nothing."""
        write_policy(path, self._content)

    def reset(self) -> None:
        """Start an episode: the states of a recurrent policy become zeros."""
        self._states: dict[str, Any] = self._zeros

    def __call__(self, observation: Observation) -> Actions:
        """Compute the deterministic action in [-1, 1], shape (2,), for one observation.

        Raises:
            PolicyError: The observation has another shape.
        """
        if observation.ndim != 1 or len(observation) < self.width:
            raise PolicyError(
                f"{self.path}: got an observation of shape {observation.shape}: must be "
                f"({self.width},), or longer"
            )
        # The last sensors may be left out of the policy.
        batch = observation[None, : self.width].astype(np.float32)
        actions, *states = self._session.run(None, {"observation": batch, **self._states})
        self._states = dict(zip(self._states, states, strict=True))
        action: Actions = actions[0]
        return action

    def _act_many(self, observations: Actions) -> Actions:
        """Compute actions (n, 2) for observations (n, numbers)."""
        # A slice of columns isn't contiguous in memory.
        batch = np.ascontiguousarray(observations[:, : self.width])
        actions: Actions = self._session.run(None, {"observation": batch})[0]
        return actions


def write_policy(path: Path, content: bytes) -> None:
    """Write the content of a policy file, all of it or nothing."""
    path.parent.mkdir(parents=True, exist_ok=True)
    reading.write_atomically(path, content, PolicyError)


def _load_session(content: bytes) -> Any:
    """Load an ONNX file, and no other format, for one thread.

    Raises:
        PolicyError: It isn't an ONNX file. The message doesn't name the file.
    """
    # What users mix up, or what would be read from elsewhere, is refused before the parser sees it.
    if content.startswith(b"PK"):
        raise PolicyError(
            "isn't an ONNX file but a zip of stable-baselines3, which can run code when it's "
            "loaded: convert it once with 'acsar-gym policy MODEL.zip --out policy.onnx --trust'"
        )
    if EXTERNAL_DATA in content:
        raise PolicyError("has weights in another file: export it as one file")
    try:
        import onnxruntime  # noqa: PLC0415 - optional
    except ImportError as error:
        raise MissingExtraError("running a policy", "deploy") from error

    # One thread, which doesn't spin: the control loop has the other cores.
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = 1
    options.inter_op_num_threads = 1
    options.execution_mode = onnxruntime.ExecutionMode.ORT_SEQUENTIAL
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")
    options.add_session_config_entry("session.load_model_format", "ONNX")
    options.log_severity_level = 4
    try:
        return onnxruntime.InferenceSession(content, options, providers=["CPUExecutionProvider"])
    except Exception as error:  # onnxruntime's errors have no common base of their own
        raise PolicyError(
            f"isn't a whole ONNX file ({format_error(error)[:150]}): copy it again, or write one "
            "with 'acsar-gym train' or 'acsar-gym policy MODEL.zip --out policy.onnx --trust'"
        ) from error
