"""Policies as single ONNX files: they run without torch, and networks of any library become one."""

from __future__ import annotations

import hashlib
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
from acsar_gym.errors import ConfigError, MissingExtraError, PolicyError
from acsar_gym.physics import Randomization
from acsar_gym.resources import AGENTS
from acsar_gym.tasks import Observation
from acsar_gym.tools.policies import trial
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


def read_network(data: bytes) -> tuple[trial.Network, Bundle]:
    """Load a network that is trusted, or was tried, and its bundle.

    Raises:
        PolicyError: it isn't a policy that this package runs; the message doesn't name the file.
        MissingExtraError: onnxruntime isn't installed.
    """
    try:
        network = trial.load_network(data)
    except ImportError as error:
        raise MissingExtraError("running a policy", "deploy") from error
    except Exception as error:
        raise PolicyError(f"not an ONNX policy: {format_error(error)}") from error
    if BUNDLE_KEY not in network.metadata:
        raise PolicyError(
            "an ONNX network without a bundle, which says what it was trained for: write it with "
            "'acsar-gym export' or acsar_gym.tools.policies.save"
        )
    bundle = parse_bundle(network.metadata[BUNDLE_KEY])
    if network.width != bundle.observation.width:
        raise PolicyError(
            f"takes {network.width} numbers, but its bundle describes {bundle.observation.width}: "
            "export the policy again"
        )
    if list(network.states) != [(one.input, one.output, one.shape) for one in bundle.state]:
        raise PolicyError(
            f"has {len(network.states)} states, which aren't the {len(bundle.state)} of its "
            "bundle: export the policy again"
        )
    return network, bundle


def open_policy_file(path: Path) -> tuple[str, trial.Network, Bundle]:
    """Read a policy file; one that doesn't come with the package is tried first, see `trial`.

    Returns:
        SHA-256 of the file, its network, and its bundle.

    Raises:
        PolicyError: the file can't be read, or isn't a policy that this package runs.
        MissingExtraError: onnxruntime isn't installed.
    """
    data = reading.read_file(path, MAX_POLICY_BYTES, PolicyError)
    packaged = path.resolve().is_relative_to(AGENTS.resolve())
    if (other := describe_other_file(data)) is not None:
        raise PolicyError(f"{path}: {other}")
    refusal = "" if packaged else trial.find_refusal(data)
    if "INVALID_PROTOBUF" in refusal:
        raise PolicyError(f"{path}: isn't a whole ONNX file: copy or export it again")
    if refusal:
        raise PolicyError(f"{path}: not a policy to run: {refusal}")
    try:
        return hashlib.sha256(data).hexdigest(), *read_network(data)
    except PolicyError as error:
        raise PolicyError(f"{path}: {error}") from error


class OnnxPolicy(FilePolicy):
    """A policy read from an ONNX file; loading runs no code from the file.

    A file that doesn't come with the package is tried in a subprocess first, with limits of memory
    and CPU time, which takes about 0.3 s.

    Args:
        path: an ONNX file, or the name of a policy that comes with the package.

    Raises:
        PolicyError: the file is missing, or isn't a policy that this package accepts.
        MissingExtraError: onnxruntime isn't installed.
    """

    bundle: Bundle

    def __init__(self, path: str | Path) -> None:
        self.path = resolve(path)
        self.sha256, network, self.bundle = open_policy_file(self.path)
        self.env_id, self.width = self.bundle.env.id, network.width
        # Arrays that are made once: faster than new ones for every decision.
        self._session = network.session
        self._run, self._binding = network.session.run_with_iobinding, network.session.io_binding()
        self._observation = self._bind("input", "observation", (1, network.width))
        self._action = self._bind("output", "action", (1, 2))
        self._states = [
            (self._bind("input", one.input, one.shape), self._bind("output", one.output, one.shape))
            for one in network.states
        ]
        if not network.states and isinstance(network.session.get_inputs()[0].shape[0], str):
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
    return found, open_policy_file(found)[2]


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
