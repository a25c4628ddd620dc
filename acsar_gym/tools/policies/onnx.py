"""Trained policies as single ONNX files, which run without torch."""

from __future__ import annotations

import hashlib
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from acsar_gym import reading
from acsar_gym.errors import MissingExtraError, PolicyError
from acsar_gym.tasks import Observation
from acsar_gym.tools.policies import graph, limits, trial
from acsar_gym.tools.policies.base import FilePolicy, format_error, resolve
from acsar_gym.tools.policies.bundle import BUNDLE_KEY, Bundle, parse_bundle

MAX_POLICY_BYTES = 32_000_000
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

    bundle: Bundle

    def __init__(self, path: str | Path) -> None:
        self.path = resolve(path)
        try:
            import onnxruntime  # noqa: F401, PLC0415 - optional
        except ImportError:
            raise MissingExtraError("running a policy", "deploy") from None
        data = reading.read_file(self.path, MAX_POLICY_BYTES, PolicyError)
        self.sha256 = hashlib.sha256(data).hexdigest()
        try:
            network, self.bundle = inspect_network(data)
            shapes = _shapes(network)
            tried = limits.plain(network) or trial.find_refusal(data, shapes)
        except PolicyError as error:
            raise PolicyError(f"{self.path}: {error}") from None
        if isinstance(tried, str) and tried:
            raise PolicyError(f"{self.path}: not a policy to run: {tried}")
        self.env_id, self.width = self.bundle.env.id, network.width
        self._session = self._started(data, shapes)
        self._decision = Decision(self._session, network)

    def _started(self, data: bytes, shapes: trial.Shapes) -> Any:
        """Start an onnxruntime session, and run it once."""
        try:
            session = trial.start_session(data)
            trial.decide_once(session, shapes)
        except Exception as error:  # noqa: BLE001 - onnxruntime's errors have no common base of their own
            raise PolicyError(f"{self.path}: not an ONNX policy: {format_error(error)}") from None
        return session

    def reset(self) -> None:
        """Begin an episode: the states of a recurrent policy become zeros."""
        self._decision.reset()

    def __call__(self, observation: Observation) -> NDArray[np.float32]:
        """Compute the deterministic action in [-1, 1], shape (2,), for one observation.

        Not for several threads at once: they share the arrays, and the states if it has some.

        Raises:
            PolicyError: the observation has another shape.
        """
        if observation.shape != (self.width,):
            raise PolicyError(
                f"{self.path}: got an observation of shape {observation.shape}: must be "
                f"({self.width},)"
            )
        return self._decision(observation)


class Decision:
    """Runs a session on arrays that are made once, which is faster than on new ones.

    Args:
        session: of onnxruntime.
        network: what the session runs.
    """

    def __init__(self, session: Any, network: graph.Graph) -> None:
        self._run, self._binding = session.run_with_iobinding, session.io_binding()
        self._observation = self._input("observation", (1, network.width))
        self._action = self._output("action", (1, 2))
        self._states = [
            (self._input(state.input, state.shape), self._output(state.output, state.shape))
            for state in network.states
        ]

    def _input(self, name: str, shape: tuple[int, ...]) -> NDArray[np.float32]:
        """Make the array that the session reads an input from."""
        array = np.zeros(shape, np.float32)
        self._binding.bind_input(name, "cpu", 0, np.float32, shape, array.ctypes.data)
        return array

    def _output(self, name: str, shape: tuple[int, ...]) -> NDArray[np.float32]:
        """Make the array that the session writes an output to."""
        array = np.zeros(shape, np.float32)
        self._binding.bind_output(name, "cpu", 0, np.float32, shape, array.ctypes.data)
        return array

    def reset(self) -> None:
        """Set all states to zero."""
        for before, _ in self._states:
            before.fill(0.0)

    def __call__(self, observation: Observation) -> NDArray[np.float32]:
        """Decide once, and keep the next states."""
        self._observation[0] = observation
        self._run(self._binding)
        for before, after in self._states:
            before[...] = after
        action: NDArray[np.float32] = self._action[0].copy()
        return action


def _shapes(network: graph.Graph) -> dict[str, tuple[int, ...]]:
    """Return the shapes of a network's inputs, for one robot."""
    return {"observation": (1, network.width)} | {s.input: s.shape for s in network.states}


def inspect_network(data: bytes) -> tuple[graph.Graph, Bundle]:
    """Parse and check the content of an ONNX file.

    Returns:
        The network, if it is acceptable as a policy, and its bundle.

    Raises:
        PolicyError: it isn't; the message doesn't name the file.
    """
    network = graph.read(data)
    limits.check(network)
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
    if [tuple(one) for one in network.states] != [
        (one.input, one.output, one.shape) for one in bundle.state
    ]:
        raise PolicyError(
            f"has {len(network.states)} states, which aren't the {len(bundle.state)} of its "
            "bundle: export the policy again"
        )
    return network, bundle
