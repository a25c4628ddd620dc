"""Policies as single ONNX files: they run without torch, and networks of any library become one."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import gymnasium
import numpy as np
from numpy.typing import NDArray

from acsar_gym import reading
from acsar_gym.config import RobotConfig
from acsar_gym.envs.ids import find_id
from acsar_gym.envs.robot_env import RobotEnv
from acsar_gym.errors import ConfigError, MissingExtraError, PolicyError, format_error
from acsar_gym.physics import Randomization
from acsar_gym.tasks import Observation
from acsar_gym.tools.policies.bundle import (
    BUNDLE_KEY,
    Bundle,
    StateLayout,
    TrainingSummary,
    describe_policy,
    parse_bundle,
)
from acsar_gym.tools.policies.policy import (
    MAX_POLICY_BYTES,
    NO_POLICY,
    FilePolicy,
    resolve,
)

if TYPE_CHECKING:
    import torch

# onnxruntime 1.29 and later look at this when they are imported. Without it they tell their maker
# what they run, and keep an id of this computer in the user's cache folder.
os.environ.setdefault("ORT_DISABLE_TELEMETRY", "1")


EXTERNAL_DATA = b"\n\x08location\x12"
"""How protobuf writes the key of a tensor's place in another file."""


def load_network(data: bytes) -> tuple[Any, Bundle]:
    """Load an ONNX file, and no other format, with one thread, and decide once.

    Returns:
        onnxruntime's session, which maps `observation` (batch, n) and states to `action` and next
        states, and the bundle.

    Raises:
        PolicyError: it isn't a policy that this package runs; the message doesn't name the file.
    """
    if data.startswith(b"PK"):
        raise PolicyError(
            "isn't an ONNX file but a zip, as stable-baselines3 writes it, which can run code when "
            "it's loaded: convert it once with 'acsar-gym export MODEL.zip policy.onnx --trust'"
        )
    if not data.startswith(b"\x08"):  # the key of `ir_version`
        raise PolicyError(NO_POLICY)
    if EXTERNAL_DATA in data:
        raise PolicyError("has weights in another file: export it as one file")
    try:
        import onnxruntime  # noqa: PLC0415 - optional
    except ImportError as error:
        raise MissingExtraError("running a policy", "deploy") from error
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    options.execution_mode = onnxruntime.ExecutionMode.ORT_SEQUENTIAL
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")
    options.add_session_config_entry("session.load_model_format", "ONNX")
    options.log_severity_level = 4
    try:
        session = onnxruntime.InferenceSession(data, options, providers=["CPUExecutionProvider"])
        bundle = _check_signature(session)
        _check_decisions(session, bundle)
    except PolicyError:
        raise
    except Exception as error:  # onnxruntime's errors have no common base of their own
        if "INVALID_PROTOBUF" in str(error):
            raise PolicyError("isn't a whole ONNX file: copy or export it again") from error
        raise PolicyError(f"not a policy to run: {format_error(error)}") from error
    return session, bundle


def _check_signature(session: Any) -> Bundle:
    """Check that a network's inputs and outputs are those of its bundle, in float32."""
    metadata = session.get_modelmeta().custom_metadata_map
    if BUNDLE_KEY not in metadata:
        raise PolicyError(
            "an ONNX network without a bundle, which says what it was trained for: write it with "
            "'acsar-gym export' or acsar_gym.tools.policies.save"
        )
    bundle = parse_bundle(metadata[BUNDLE_KEY])
    inputs, outputs = session.get_inputs(), session.get_outputs()
    names = [[put.name[:40] for put in side[:5]] for side in (inputs, outputs)]
    if [side[:1] for side in names] != [["observation"], ["action"]]:
        raise PolicyError(f"must map 'observation' to 'action', maps {names[0]} to {names[1]}")
    if any(put.type != "tensor(float)" for put in (*inputs, *outputs)):
        raise PolicyError("must have inputs and outputs of float32")
    width, shape = bundle.observation.width, inputs[0].shape
    if len(shape) != 2 or shape[1] != width:
        raise PolicyError(
            f"takes {shape[-1]} numbers, but its bundle describes {width}: export the policy again"
        )
    states = [(put.name, tuple(put.shape)) for put in inputs[1:]]
    if [(state.input, state.shape) for state in bundle.state] != states or [
        state.output for state in bundle.state
    ] != [put.name for put in outputs[1:]]:
        raise PolicyError(
            f"has {len(states)} states, which aren't the {len(bundle.state)} of its bundle: export "
            "the policy again"
        )
    return bundle


def _check_decisions(session: Any, bundle: Bundle) -> None:
    """Check that an observation of zeros gets the same two finite numbers twice."""
    zeros = {state.input: np.zeros(state.shape, np.float32) for state in bundle.state}
    zeros["observation"] = np.zeros((1, bundle.observation.width), np.float32)
    action, *states = session.run(None, zeros)
    if action.shape != (1, 2):
        raise PolicyError(f"gives shape {action.shape}: must be (1, 2)")
    if not np.isfinite(action).all():
        raise PolicyError(f"gives {action[0].tolist()} for an observation of zeros")
    if [state.shape for state in states] != [state.shape for state in bundle.state]:
        raise PolicyError("gives states of other shapes than it takes")
    if not np.array_equal(action, session.run(None, zeros)[0]):
        raise PolicyError("decides at random: must give the same action for the same observation")


class OnnxPolicy(FilePolicy):
    """A policy read from an ONNX file; loading runs no code from the file.

    Args:
        path: an ONNX file, or the name of a policy that comes with the package.

    Raises:
        PolicyError: the file is missing, or isn't a policy that this package accepts.
        MissingExtraError: onnxruntime isn't installed.
    """

    bundle: Bundle

    def __init__(self, path: str | Path) -> None:
        self.path = resolve(path)
        data = reading.read_file(self.path, MAX_POLICY_BYTES, PolicyError)
        try:
            self._session, self.bundle = load_network(data)
        except PolicyError as error:
            raise PolicyError(f"{self.path}: {error}") from error
        self.sha256 = hashlib.sha256(data).hexdigest()
        self.width, self.env_id = self.bundle.observation.width, self.bundle.env.id
        # Arrays that are made once: faster than new ones for every decision.
        self._run, self._binding = self._session.run_with_iobinding, self._session.io_binding()
        self._observation = self._bind("input", "observation", (1, self.width))
        self._action = self._bind("output", "action", (1, 2))
        self._states = [
            (self._bind("input", one.input, one.shape), self._bind("output", one.output, one.shape))
            for one in self.bundle.state
        ]
        if not self.bundle.state and isinstance(self._session.get_inputs()[0].shape[0], str):
            self.act_many = self._act_many

    def _bind(self, side: str, name: str, shape: tuple[int, ...]) -> NDArray[np.float32]:
        """Make the array that the session reads an input from, or writes an output to."""
        array = np.zeros(shape, np.float32)
        bind = getattr(self._binding, f"bind_{side}")
        bind(name, "cpu", 0, np.float32, shape, array.ctypes.data)
        return array

    def reset(self) -> None:
        """Begin an episode: the states of a recurrent policy become zeros."""
        for before, _ in self._states:
            before.fill(0.0)

    def __call__(self, observation: Observation) -> NDArray[np.float32]:
        """Compute the deterministic action in [-1, 1], shape (2,), for one observation.

        Not for several threads at once: they share the arrays, and the states if it has some.

        Raises:
            PolicyError: the observation has another shape.
        """
        if observation.ndim != 1 or len(observation) < self.width:
            raise PolicyError(
                f"{self.path}: got an observation of shape {observation.shape}: must be "
                f"({self.width},), or longer"
            )
        self._observation[0] = observation[: self.width]
        self._run(self._binding)
        for before, after in self._states:
            before[...] = after
        action: NDArray[np.float32] = self._action[0].copy()
        return action

    def _act_many(self, observations: NDArray[np.float32]) -> NDArray[np.float32]:
        """Compute actions (n, 2) for observations (n, numbers)."""
        seen = np.ascontiguousarray(observations[:, : self.width])
        actions: NDArray[np.float32] = self._session.run(None, {"observation": seen})[0]
        return actions


def actor(network: torch.nn.Module, call: Callable[[Any, torch.Tensor], Any]) -> torch.nn.Module:
    """Adapt a network of another library to `save`, which wants observations in, actions out.

    For instance TorchRL's, which returns mean and scale before the tanh of its distribution:
    `policies.save(policies.actor(network, lambda net, seen: net(seen)[0].tanh()), ...)`.

    Args:
        network: any module; its weights become part of the file.
        call: called with the network and observations (batch, n); returns actions (batch, 2).

    Returns:
        A module that maps observations (batch, n) to actions (batch, 2).

    Raises:
        MissingExtraError: torch, onnx or onnxscript isn't installed.
    """
    from acsar_gym.tools.policies import export  # noqa: PLC0415 - optional

    return export.Actor(network, call)


def save(
    module: torch.nn.Module,
    env_id: str,
    path: str | Path,
    *,
    normalizer: Sequence[Any] | torch.nn.Module | None = None,
    robot: RobotConfig | str | Path | None = None,
    training: TrainingSummary | None = None,
    state: Sequence[StateLayout] = (),
    **env_kwargs: Any,
) -> None:
    """Write a trained network as an ONNX policy, for `acsar-gym evaluate` and `run`.

    Args:
        module: maps observations (batch, n) to actions (batch, 2), which are clipped to [-1, 1].
        env_id: the env of the training, such as "acsar_gym/PointGoal-v0".
        path: the ONNX file to write.
        normalizer: of the observations: (mean, std), (mean, std, clip) or a module; mean and std
            are numbers or arrays (n,). It becomes part of the file.
        robot: preset, file or config of the robot that it was trained on.
        training: how it was trained.
        state: of a recurrent module, (observation, state, ...) to (action, next state, ...).
        **env_kwargs: other arguments of the env in the training, such as policy_rate=20.0 or
            randomization; the file stores what follows from them.

    Raises:
        ConfigError: there is no such environment, or it doesn't take these arguments.
        PolicyError: the module doesn't fit the env, or can't be exported.
        MissingExtraError: torch, onnx or onnxscript isn't installed.
    """
    from acsar_gym.tools.policies import export  # noqa: PLC0415 - optional

    before = export.make_normalizer(normalizer)
    try:
        env = gymnasium.make(find_id(env_id), link="planar", robot=robot, **env_kwargs).unwrapped
    except (gymnasium.error.Error, ImportError) as error:
        raise ConfigError(f"{env_id}: {error}") from error
    except TypeError as error:
        raise ConfigError(
            f"{env_id}: doesn't take these arguments: {format_error(error)}"
        ) from error
    try:
        if not isinstance(env, RobotEnv):
            raise ConfigError(f"{env_id}: not an environment of acsar_gym")
        ranges = Randomization.of(env_kwargs.get("randomization"), env.robot.config)
        bundle = describe_policy(env, env_id, randomization=ranges, training=training, state=state)
        export.write_network(module, Path(path), bundle, before)
    finally:
        env.close()
