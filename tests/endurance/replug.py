"""A cable that is pulled a thousand times: every time the same environment must drive on.

    python tests/endurance/replug.py --cycles 1000

drives a robot behind `acsar-gym emulate` in another process, pulls its cable at a random moment,
and plugs it in again as another device. In some cycles it stays out for longer than a reset waits,
which then must say so. Fails where a cycle neither recovered nor was reported, or where the program
holds more descriptors, processes or memory than before.
"""

from __future__ import annotations

import argparse
import contextlib
import gc
import os
import random
import signal
import sys
import tempfile
import threading
import time
from collections import Counter
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import psutil

from acsar_gym import RobotConfig
from acsar_gym.errors import LinkError
from acsar_gym.guard import watchdog
from acsar_gym.tools.emulation.board import run_emulator

CURVE = np.array([0.3, 0.5], np.float32)
STAYS_OUT = 0.1
"""Share of cycles in which the cable stays out for longer."""
MOST_STEPS = 30
"""Steps after the pull, at most: a lost port is noticed in the next one."""
MOST_GROWTH = 4_000_000
"""Of memory, after the first cycles [bytes]."""
FIRST = 2
"""Cycles before memory and descriptors are counted for the first time."""
PATIENCE = 20.0
"""Longest wait for the device [s]."""


class Board:
    """The emulator's process, and the lasting name of its device."""

    def __init__(self, process: psutil.Process, name: Path) -> None:
        self._process = process
        self._name = name

    def pull(self) -> None:
        self._process.send_signal(signal.SIGUSR1)

    def plug(self) -> None:
        self._process.send_signal(signal.SIGUSR2)

    def wait(self, *, plugged: bool) -> None:
        """Return when the device is there, or gone."""
        deadline = time.monotonic() + PATIENCE
        while self._name.is_symlink() != plugged:
            if time.monotonic() > deadline:
                raise TimeoutError(f"{self._name}: not {'there' if plugged else 'gone'}")
            time.sleep(0.002)


def cycle(env: Any, board: Board, rng: random.Random) -> str:
    """What became of one pull: recovered, reported, or what went wrong."""
    if not env.unwrapped.robot.active:  # the last cycle went wrong
        board.plug()
        env.reset()
    for _ in range(rng.randrange(4)):
        env.step(CURVE)
    pull = threading.Timer(rng.uniform(0.0, 0.2), board.pull)
    pull.start()
    fault = _fault(env)
    pull.join()
    board.wait(plugged=False)
    if not fault:
        return "unnoticed"
    if rng.random() < STAYS_OUT:
        try:
            env.reset()
        except LinkError:
            board.plug()
            board.wait(plugged=True)
            return "reported" if _recovers(env) else "lost"
        return "reset without a cable"
    back = threading.Timer(rng.uniform(0.0, 0.3), board.plug)
    back.start()
    recovers = _recovers(env)
    back.join()
    return "recovered" if recovers else "lost"


def _fault(env: Any) -> bool:
    """Whether a fault ends the episode, and says why."""
    for _ in range(MOST_STEPS):
        *_, truncated, info = env.step(CURVE)
        if truncated:
            return bool(info["fault"] == 3.0 and info["fault_reason"])
    return False


def _recovers(env: Any) -> bool:
    """Whether a reset, and a step after it, are without a fault."""
    try:
        env.reset()
    except LinkError as error:
        print(f"not recovered: {error}", file=sys.stderr)
        return False
    info = env.step(CURVE)[-1]
    if info["fault"]:
        print(f"recovered, but: {info['fault_reason']}", file=sys.stderr)
    return not info["fault"]


def held(process: psutil.Process) -> dict[str, int]:
    """What this program holds; the emulator isn't counted."""
    gc.collect()
    return {
        "descriptors": len(os.listdir("/proc/self/fd")),  # noqa: PTH208 - only their number counts
        "children": len(process.children()) - 1,
        "memory": process.memory_info().rss,
    }


def run(board: Board, device: str, cycles: int, seed: int, reconnect: float) -> bool:
    """Whether all went well; prints the figures."""
    config = RobotConfig.preset("acsar").with_(
        connect_timeout=PATIENCE,
        feedback_timeout=5.0,
        reconnect_timeout=reconnect,
        watchdog_timeout=2.0,  # a busy machine is another matter
    )
    env = gymnasium.make(
        "acsar_gym/PointGoal-v0", link=device, robot=config, max_episode_steps=10**9
    )
    rng, process, became = random.Random(seed), psutil.Process(), Counter[str]()
    begin = time.monotonic()
    env.reset(seed=seed)
    env.step(CURVE)
    before = held(process)
    for number in range(cycles):
        try:
            became[cycle(env, board, rng)] += 1
        except LinkError as error:
            became["lost"] += 1
            print(f"not recovered: {error}", file=sys.stderr)
        if number + 1 == FIRST:
            before = held(process)
        if (number + 1) % 100 == 0:
            print(f"{number + 1} cycles: {dict(became)}", flush=True)
    after = held(process)
    env.close()
    watchdog.end_searches()
    left = len(process.children()) - 1
    bad = cycles - became["recovered"] - became["reported"]
    growth = after["memory"] - before["memory"]
    print(
        f"{cycles} cycles in {time.monotonic() - begin:.0f} s: {became['recovered']} recovered, "
        f"{became['reported']} reported, {bad} neither; "
        f"descriptors {before['descriptors']} -> {after['descriptors']}, "
        f"memory {before['memory'] / 1e6:.1f} -> {after['memory'] / 1e6:.1f} MB, "
        f"child processes left: {left}"
    )
    same = after["descriptors"] == before["descriptors"] and after["children"] == before["children"]
    return bad == 0 and same and left == 0 and growth < MOST_GROWTH


def main() -> int:
    """Exit code 0 where every cycle went well and nothing grew."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--cycles", type=int, default=1000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--reconnect", type=float, default=0.5, help="a reset's patience [s]")
    options = parser.parse_args()
    with contextlib.ExitStack() as stack:
        name = Path(stack.enter_context(tempfile.TemporaryDirectory())) / "usb-acsar"
        stack.enter_context(run_emulator("--name", str(name)))
        (process,) = psutil.Process().children()
        board = Board(process, name)
        return int(not run(board, str(name), options.cycles, options.seed, options.reconnect))


if __name__ == "__main__":
    sys.exit(main())
