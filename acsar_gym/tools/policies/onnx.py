"""Policies as single ONNX files: they run without torch, and networks of any library become one."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import gymnasium
import numpy as np
from numpy.typing import NDArray

from acsar_gym import reading
from acsar_gym.config import RobotConfig
from acsar_gym.envs.ids import find_id
from acsar_gym.envs.robot_env import RobotEnv
from acsar_gym.errors import ConfigError, MissingExtraError, PolicyError
from acsar_gym.physics import Randomization
from acsar_gym.tasks import Observation
from acsar_gym.tools.policies.bundle import (
    BUNDLE_KEY,
    Bundle,
    StateLayout,
    TrainingSummary,
    parse_bundle,
)
from acsar_gym.tools.policies.describe import describe_policy
from acsar_gym.tools.policies.kinds import describe_other_file
from acsar_gym.tools.policies.policy import MAX_POLICY_BYTES, FilePolicy, format_error, resolve

if TYPE_CHECKING:
    import torch

# onnxruntime 1.29 and later look at this when they are imported. Without it they tell their maker
# what they run, and keep an id of this computer in the user's cache folder.
os.environ.setdefault("ORT_DISABLE_TELEMETRY", "1")


EXTERNAL_DATA = b"\n\x08location\x12"
"""How protobuf writes the key of a tensor's place in another file."""


class Network(NamedTuple):
    """An ONNX network that maps `observation` (batch, n) and states to `action` and next states."""

    session: Any
    """Of onnxruntime."""
    bundle: Bundle


def open_policy_file(path: Path) -> tuple[str, Network]:
    """Read a policy file.

    Returns:
        SHA-256 of the file, and its network.

    Raises:
        PolicyError: the file can't be read, or isn't a policy that this package runs.
        MissingExtraError: onnxruntime isn't installed.
    """
    data = reading.read_file(path, MAX_POLICY_BYTES, PolicyError)
    if (other := describe_other_file(data)) is not None:
        raise PolicyError(f"{path}: {other}")
    try:
        return hashlib.sha256(data).hexdigest(), load_network(data)
    except ImportError as error:
        raise MissingExtraError("running a policy", "deploy") from error
    except PolicyError as error:
        raise PolicyError(f"{path}: {error}") from error
    except Exception as error:  # onnxruntime's errors have no common base of their own
        if "INVALID_PROTOBUF" in str(error):
            raise PolicyError(
                f"{path}: isn't a whole ONNX file: copy or export it again"
            ) from error
        raise PolicyError(f"{path}: not a policy to run: {format_error(error)}") from error


def load_network(data: bytes) -> Network:
    """Load an ONNX file, and no other format, with one thread, and decide once.

    Raises:
        PolicyError: it isn't a policy that this package runs; the message doesn't name the file.
    """
    import onnxruntime  # noqa: PLC0415 - optional

    if EXTERNAL_DATA in data:
        raise PolicyError("has weights in another file: export it as one file")
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    options.execution_mode = onnxruntime.ExecutionMode.ORT_SEQUENTIAL
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")
    options.add_session_config_entry("session.load_model_format", "ONNX")
    options.log_severity_level = 4
    session = onnxruntime.InferenceSession(data, options, providers=["CPUExecutionProvider"])
    inputs, outputs = session.get_inputs(), session.get_outputs()
    names = [[put.name[:40] for put in puts[:5]] for puts in (inputs, outputs)]
    if [found[:1] for found in names] != [["observation"], ["action"]]:
        raise PolicyError(f"must map 'observation' to 'action', maps {names[0]} to {names[1]}")
    for put in (*inputs, *outputs):
        if put.type != "tensor(float)":
            raise PolicyError(f"{put.name[:40]} must be float32")
    if len(inputs[0].shape) != 2 or not isinstance(inputs[0].shape[1], int):
        raise PolicyError("observation must be of shape (batch, n)")
    if len(inputs) != len(outputs):
        raise PolicyError(f"must have an output for every state, maps {names[0]} to {names[1]}")
    metadata = session.get_modelmeta().custom_metadata_map
    if BUNDLE_KEY not in metadata:
        raise PolicyError(
            "an ONNX network without a bundle, which says what it was trained for: write it with "
            "'acsar-gym export' or acsar_gym.tools.policies.save"
        )
    bundle, width = parse_bundle(metadata[BUNDLE_KEY]), inputs[0].shape[1]
    if width != bundle.observation.width:
        raise PolicyError(
            f"takes {width} numbers, but its bundle describes {bundle.observation.width}: export "
            "the policy again"
        )
    states = [
        (one.name, after.name, tuple(one.shape)) for one, after in zip(inputs, outputs, strict=True)
    ][1:]
    if states != [(one.input, one.output, one.shape) for one in bundle.state]:
        raise PolicyError(
            f"has {len(states)} states, which aren't the {len(bundle.state)} of its bundle: export "
            "the policy again"
        )
    network = Network(session, bundle)
    check_decisions(network)
    return network


def check_decisions(network: Network) -> None:
    """Check what a network decides for zeros.

    Raises:
        PolicyError: the action isn't two finite numbers of shape (1, 2), a state comes out in
            another shape than it goes in, or the same observation gets different actions.
    """
    zeros = {one.input: np.zeros(one.shape, np.float32) for one in network.bundle.state}
    zeros["observation"] = np.zeros((1, network.bundle.observation.width), np.float32)
    action, *states = network.session.run(None, zeros)
    if action.shape != (1, 2):
        raise PolicyError(f"gives shape {action.shape}: must be (1, 2)")
    if not np.isfinite(action).all():
        raise PolicyError(f"gives {action[0].tolist()} for an observation of zeros")
    for state, after in zip(network.bundle.state, states, strict=True):
        if state.shape != after.shape:
            raise PolicyError(f"gives a state of shape {after.shape}: must be {state.shape}")
    if not np.array_equal(action, network.session.run(None, zeros)[0]):
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
        self.sha256, network = open_policy_file(self.path)
        self.bundle, self.width = network.bundle, network.bundle.observation.width
        self.env_id = self.bundle.env.id
        # Arrays that are made once: faster than new ones for every decision.
        self._session = network.session
        self._run, self._binding = network.session.run_with_iobinding, network.session.io_binding()
        self._observation = self._bind("input", "observation", (1, self.width))
        self._action = self._bind("output", "action", (1, 2))
        self._states = [
            (self._bind("input", one.input, one.shape), self._bind("output", one.output, one.shape))
            for one in self.bundle.state
        ]
        if not self.bundle.state and isinstance(network.session.get_inputs()[0].shape[0], str):
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


def read_bundle(path: str | Path) -> tuple[Path, Bundle]:
    """Read what a policy file says about itself.

    Args:
        path: an ONNX file, or the name of a policy that comes with the package.

    Returns:
        Path of the file, and its bundle.

    Raises:
        PolicyError: the file is missing, or isn't a policy that this package accepts.
        MissingExtraError: onnxruntime isn't installed.
    """
    found = resolve(path)
    return found, open_policy_file(found)[1].bundle


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
