"""One decision of an ONNX file in a process of its own, with limits of memory and time.

    python -P trial.py WIDTH < policy.onnx

It stands alone, as importing the package would take longer than the trial.
"""

from __future__ import annotations

import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np

MEMORY = 300_000_000
"""Bytes that a network may take."""
PROCESSOR_TIME = 0.7
"""What its first decision may take, loading included [s]."""
PATIENCE = 30.0
"""How long to wait for it on a busy machine [s]."""


def refusal(data: bytes, width: int) -> str:
    """What is wrong with a network's first decision; empty where nothing is."""
    command = [sys.executable, "-P", __file__, str(width)]
    try:
        done = subprocess.run(
            command, input=data, capture_output=True, timeout=PATIENCE, check=False
        )
    except subprocess.TimeoutExpired:
        return f"its first decision takes over {PATIENCE:g} s"
    said = done.stderr.decode("utf-8", "replace").strip().rpartition("\n")[2]
    if done.returncode < 0 or "alloc" in said:
        return f"its first decision takes over {PROCESSOR_TIME:g} s or {MEMORY / 1e6:g} MB"
    return said[:200] if done.returncode else ""


def session(data: bytes) -> Any:
    """An onnxruntime session of an ONNX file on one thread; nothing else is read as one."""
    import onnxruntime  # noqa: PLC0415 - optional

    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    options.log_severity_level = 4
    options.add_session_config_entry("session.load_model_format", "ONNX")
    return onnxruntime.InferenceSession(data, options, providers=["CPUExecutionProvider"])


def decide(run: Any, width: int) -> None:
    """ValueError where a session doesn't make two finite float32 of a row of zeros."""
    (action,) = run.run(["action"], {"observation": np.zeros((1, width), np.float32)})
    if action.shape != (1, 2) or action.dtype != np.float32:
        raise ValueError(f"gives {action.dtype} of shape {action.shape}: must be float32 (1, 2)")
    if not np.isfinite(action).all():
        raise ValueError(f"gives {action[0].tolist()} for an observation of zeros")


def _limit() -> None:
    try:
        import resource  # noqa: PLC0415 - not on Windows
    except ImportError:
        return
    signal.setitimer(signal.ITIMER_PROF, PROCESSOR_TIME)  # whose signal ends the process
    try:  # Linux tells; the peak would be that of the program that started this one
        used = int(Path("/proc/self/statm").read_text().split()[5]) * resource.getpagesize()
    except OSError:
        used = 1024 * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    resource.setrlimit(resource.RLIMIT_DATA, (used + MEMORY, used + MEMORY))


def _main() -> None:
    import onnxruntime  # noqa: F401, PLC0415 - before the limits: it isn't the network's cost

    data = sys.stdin.buffer.read()
    _limit()
    try:
        decide(session(data), int(sys.argv[1]))
    except Exception as error:  # noqa: BLE001 - onnxruntime's errors have no common base of their own
        sys.exit(" ".join(str(error).split()) or type(error).__name__)


if __name__ == "__main__":
    _main()
