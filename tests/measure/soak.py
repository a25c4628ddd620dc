"""Half an hour at 100 Hz over a pseudo-terminal: memory, descriptors and lines must stay flat.

    python tests/measure/soak.py --minutes 30

drives a robot behind `acsar-gym emulate` with random actions, resets every minute, and fails if
memory or descriptors grow, a line is lost, or the robot is stopped.
"""

from __future__ import annotations

import argparse
import gc
import os
import sys
from typing import Any

import gymnasium
import numpy as np
import psutil

from acsar_gym.tools.emulation.board import run_emulator

MAX_GROWTH = 4_000_000
"""Of memory after the first minute [bytes]."""
STEPS_A_MINUTE = 600


def main() -> int:
    """Print a line a minute. The exit code is 0 if everything stayed flat."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--minutes", type=int, default=30)
    minutes = parser.parse_args().minutes
    process = psutil.Process()
    rng = np.random.default_rng(0)
    faults = 0
    start_memory = 0
    start_files = 0
    with run_emulator() as devices:
        env = gymnasium.make("acsar_gym/PointGoal-v0", link=devices.robot, max_episode_steps=10**9)
        robot: Any = env.unwrapped
        for minute in range(minutes):
            env.reset(seed=minute)
            for step in range(STEPS_A_MINUTE):
                if step % 5 == 0:
                    action = rng.uniform(-1.0, 1.0, 2).astype(np.float32)
                *_, terminated, truncated, info = env.step(action)
                if truncated:
                    faults += 1
                    print(f"minute {minute}: {info['fault_reason']}", flush=True)
                if terminated or truncated:
                    env.reset()

            gc.collect()
            memory = process.memory_info().rss
            files = len(os.listdir("/proc/self/fd"))  # noqa: PTH208
            refused = sum(robot.robot.wire.decoder.refused.values())
            start_memory = start_memory or memory
            start_files = start_files or files
            print(
                f"minute {minute}: {refused} lines refused, {memory / 1e6:.1f} MB, "
                f"{files} descriptors",
                flush=True,
            )
            is_flat = memory - start_memory <= MAX_GROWTH and files == start_files
            faults += refused > 0 or not is_flat
        env.close()
    print("flat" if faults == 0 else f"{faults} faults, or minutes that weren't flat")
    return int(faults > 0)


if __name__ == "__main__":
    sys.exit(main())
