"""Loads ONNX networks; those of strangers are tried in a subprocess with limits first.

    python -P trial.py < policy.onnx

The subprocess runs this file as a script, which imports neither acsar_gym nor what it needs: that
would take longer than the trial itself.
"""

from __future__ import annotations

import contextlib
import math
import os
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

# onnxruntime 1.29 and later look at this when they are imported. Without it they tell their maker
# what they run, and keep an id of this computer in the user's cache folder.
os.environ.setdefault("ORT_DISABLE_TELEMETRY", "1")

MEMORY_LIMIT = 300_000_000
"""Memory limit of a network in its trial [bytes]."""
CPU_TIME_LIMIT = 1.0
"""CPU time limit of loading it and of the decisions of its trial [s]."""
TRIAL_TIMEOUT = 30.0
"""Time limit by the wall clock, for a busy machine [s]."""
MAX_WIDTH = 100_000
"""Largest accepted size of an observation, and of a state."""
MAX_STATES = 16
"""Most states of a recurrent network."""
PROBES = (1.0, -1.0, 1e9, -1e9)
"""Observations that a trial has besides zeros: time and memory must not grow with any of them."""


class NetworkState(NamedTuple):
    """A state of a recurrent network: names of input and output, and the shape of both."""

    input: str
    output: str
    shape: tuple[int, ...]


class Network(NamedTuple):
    """An ONNX network that maps `observation` (batch, n) and states to `action` and next states."""

    session: Any
    """Of onnxruntime."""
    width: int
    """Size n of the observation."""
    states: tuple[NetworkState, ...]
    metadata: dict[str, str]


def find_refusal(data: bytes) -> str:
    """Try a network in a subprocess, which can open no files.

    Returns:
        Why the network is refused; empty if it is accepted.
    """
    command = [sys.executable, "-P", __file__]
    try:
        done = subprocess.run(
            command, input=data, capture_output=True, timeout=TRIAL_TIMEOUT, check=False
        )
    except subprocess.TimeoutExpired:
        return f"its trial takes over {TRIAL_TIMEOUT:g} s"
    said = done.stderr.decode("utf-8", "replace").strip().rpartition("\n")[2]
    if done.returncode < 0 or "alloc" in said:
        return f"its trial takes over {CPU_TIME_LIMIT:g} s or {MEMORY_LIMIT / 1e6:g} MB, or crashes"
    return said[:200] if done.returncode else ""


def load_network(data: bytes) -> Network:
    """Load an ONNX file, and no other format, with one thread.

    Raises:
        ValueError: it has other inputs or outputs than a policy. onnxruntime has errors of its own
            for what it can't load.
    """
    import onnxruntime  # noqa: PLC0415 - optional

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
        raise ValueError(f"must map 'observation' to 'action', maps {names[0]} to {names[1]}")
    for put in (*inputs, *outputs):
        if put.type != "tensor(float)":
            raise ValueError(f"{put.name[:40]} must be float32")
    seen = inputs[0].shape
    if len(seen) != 2 or (seen[0] not in (1, None) and not isinstance(seen[0], str)):
        raise ValueError("observation must be of shape (batch, n)")
    if not isinstance(seen[1], int) or not 0 < seen[1] <= MAX_WIDTH:
        raise ValueError(f"observation must be of shape (batch, n), has n = {seen[1] or '?'}")
    if len(inputs) != len(outputs) or len(inputs) > MAX_STATES + 1:
        raise ValueError(f"must have an output for every state, maps {names[0]} to {names[1]}")
    states = []
    for before, after in zip(inputs[1:], outputs[1:], strict=True):
        shape = tuple(before.shape)
        if not all(isinstance(size, int) and size > 0 for size in shape):
            raise ValueError(f"state {before.name[:40]!r}: must have one constant shape")
        if math.prod(shape) > MAX_WIDTH:
            raise ValueError(f"state {before.name[:40]!r}: shape {shape[:8]} can't be used")
        states.append(NetworkState(before.name, after.name, shape))
    metadata = dict(session.get_modelmeta().custom_metadata_map)
    return Network(session, seen[1], tuple(states), metadata)


def decide_once(network: Network, value: float = 0.0) -> list[NDArray[Any]]:
    """Run a network on observations and states that are all `value`; returns its outputs."""
    shapes = {"observation": (1, network.width)} | {s.input: s.shape for s in network.states}
    inputs = {name: np.full(shape, value, np.float32) for name, shape in shapes.items()}
    outputs: list[NDArray[Any]] = network.session.run(None, inputs)
    return outputs


def check_decisions(network: Network) -> None:
    """Check what a network decides for zeros.

    Raises:
        ValueError: the action isn't two finite float32 numbers of shape (1, 2), a state comes out
            in another shape than it goes in, or the same observation gets different actions.
    """
    action, *states = decide_once(network)
    if action.shape != (1, 2):
        raise ValueError(f"gives shape {action.shape}: must be (1, 2)")
    if not np.isfinite(action).all():
        raise ValueError(f"gives {action[0].tolist()} for an observation of zeros")
    for state, after in zip(network.states, states, strict=True):
        if state.shape != after.shape:
            raise ValueError(f"gives a state of shape {after.shape}: must be {state.shape}")
    if not np.array_equal(action, decide_once(network)[0]):
        raise ValueError("decides at random: must give the same action for the same observation")


def _run_trial() -> None:
    """Try the network on stdin; a refusal is the exit message."""
    import onnxruntime  # noqa: F401, PLC0415 - before the limits: it isn't the network's cost

    data = sys.stdin.buffer.read()
    with contextlib.suppress(ImportError):  # Windows has no limits
        import resource  # noqa: PLC0415

        signal.setitimer(signal.ITIMER_PROF, CPU_TIME_LIMIT)  # SIGPROF ends the process
        try:  # current use on Linux: ru_maxrss there includes the peak of the parent process
            used = int(Path("/proc/self/statm").read_text().split()[5]) * resource.getpagesize()
        except OSError:
            used = 1024 * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        resource.setrlimit(resource.RLIMIT_DATA, (used + MEMORY_LIMIT, used + MEMORY_LIMIT))
        resource.setrlimit(resource.RLIMIT_NOFILE, (0, 0))  # no weights from other files
    try:
        network = load_network(data)
        check_decisions(network)
        for value in PROBES:
            try:
                decide_once(network, value)
            except Exception as error:
                if "alloc" in str(error):  # others don't cost anything: a robot sees no such thing
                    raise
    except Exception as error:  # noqa: BLE001 - onnxruntime's errors have no common base of their own
        sys.exit(" ".join(str(error).split()) or type(error).__name__)


if __name__ == "__main__":
    _run_trial()
