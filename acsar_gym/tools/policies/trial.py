"""Runs one decision of an ONNX file in a subprocess with limits of memory and CPU time.

    python -P trial.py '{"observation": [1, 7]}' < policy.onnx

This script doesn't import acsar_gym, as that would take longer than the trial itself.
"""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

# onnxruntime 1.29 and later look at this when they are imported. Without it they tell their maker
# what they run, and keep an id of this computer in the user's cache folder.
os.environ.setdefault("ORT_DISABLE_TELEMETRY", "1")

MEMORY_LIMIT = 300_000_000
"""Memory limit of a network [bytes]."""
CPU_TIME_LIMIT = 0.7
"""CPU time limit of loading and the first decision [s]."""
TRIAL_TIMEOUT = 30.0
"""Time limit by the wall clock, for a busy machine [s]."""


Shapes = Mapping[str, tuple[int, ...]]
"""Shapes of a network's inputs by name: of the observation, and of its states."""


def find_refusal(data: bytes, shapes: Shapes) -> str:
    """Try one decision of a network in a subprocess.

    Args:
        data: content of the ONNX file.
        shapes: of its inputs.

    Returns:
        Why the network is rejected; empty if it is accepted.
    """
    command = [sys.executable, "-P", __file__, json.dumps(shapes)]
    try:
        done = subprocess.run(
            command, input=data, capture_output=True, timeout=TRIAL_TIMEOUT, check=False
        )
    except subprocess.TimeoutExpired:
        return f"its first decision takes over {TRIAL_TIMEOUT:g} s"
    said = done.stderr.decode("utf-8", "replace").strip().rpartition("\n")[2]
    if done.returncode < 0 or "alloc" in said:
        return f"its first decision takes over {CPU_TIME_LIMIT:g} s or {MEMORY_LIMIT / 1e6:g} MB"
    return said[:200] if done.returncode else ""


def start_session(data: bytes) -> Any:
    """Load an ONNX file, and no other format, into an onnxruntime session with one thread."""
    import onnxruntime  # noqa: PLC0415 - optional

    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    options.execution_mode = onnxruntime.ExecutionMode.ORT_SEQUENTIAL
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")
    options.log_severity_level = 4
    options.add_session_config_entry("session.load_model_format", "ONNX")
    return onnxruntime.InferenceSession(data, options, providers=["CPUExecutionProvider"])


def decide_once(run: Any, shapes: Shapes) -> None:
    """Run a session once on zeros.

    Raises:
        ValueError: the action isn't two finite float32 numbers of shape (1, 2), or a state comes
            out in another shape or type than it goes in.
    """
    zeros = {name: np.zeros(shape, np.float32) for name, shape in shapes.items()}
    action, *states = run.run(None, zeros)
    if action.shape != (1, 2) or action.dtype != np.float32:
        raise ValueError(f"gives {action.dtype} of shape {action.shape}: must be float32 (1, 2)")
    if not np.isfinite(action).all():
        raise ValueError(f"gives {action[0].tolist()} for an observation of zeros")
    for before, after in zip(list(zeros.values())[1:], states, strict=True):
        if (before.shape, before.dtype) != (after.shape, after.dtype):
            raise ValueError(f"gives a state of shape {after.shape}: must be {before.shape}")


def _limit() -> None:
    """Limit CPU time and memory of this process, where the platform supports it."""
    try:
        import resource  # noqa: PLC0415 - not on Windows
    except ImportError:
        return
    signal.setitimer(signal.ITIMER_PROF, CPU_TIME_LIMIT)  # SIGPROF ends the process
    try:  # current use on Linux: ru_maxrss there includes the peak of the parent process
        used = int(Path("/proc/self/statm").read_text().split()[5]) * resource.getpagesize()
    except OSError:
        used = 1024 * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    resource.setrlimit(resource.RLIMIT_DATA, (used + MEMORY_LIMIT, used + MEMORY_LIMIT))


def _main() -> None:
    """Run the trial of the file on stdin; a failure is the exit message."""
    import onnxruntime  # noqa: F401, PLC0415 - before the limits: it isn't the network's cost

    data = sys.stdin.buffer.read()
    _limit()
    try:
        decide_once(start_session(data), json.loads(sys.argv[1]))
    except Exception as error:  # noqa: BLE001 - onnxruntime's errors have no common base of their own
        sys.exit(" ".join(str(error).split()) or type(error).__name__)


if __name__ == "__main__":
    _main()
