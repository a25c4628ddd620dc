"""Half an hour at 100 Hz over a pseudo-terminal: memory, descriptors and lines must stay flat.

    python tests/endurance/soak.py --minutes 30

drives a robot behind `acsar-gym emulate` in another process with random actions, resets every
minute, and fails where memory or descriptors grow, a line is lost, or the wheel check stops it.
"""

from __future__ import annotations

import argparse
import gc
import os
import sys
import time

import gymnasium
import numpy as np
import psutil

from acsar_gym.envs.robot_env import RobotEnv
from acsar_gym.tools.emulation.board import run_emulator

MOST_GROWTH = 4_000_000
"""Of memory after the first minute [bytes]."""
STEPS_A_MINUTE = 600
STEPS_AN_ACTION = 5
WHEEL = 6.0
"""Info's `fault` of a wheel that contradicts its commands."""


def main() -> int:
    """Exit code 0 where everything stayed flat."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--minutes", type=int, default=30)
    minutes = parser.parse_args().minutes
    process, faults, stops = psutil.Process(), 0, 0
    rng = np.random.default_rng(0)
    with run_emulator() as devices:
        env = gymnasium.make("acsar_gym/PointGoal-v0", link=devices.robot, max_episode_steps=10**9)
        inner = env.unwrapped
        if not isinstance(inner, RobotEnv):
            raise TypeError(f"{inner} is no robot")
        first: tuple[int, int] | None = None
        for minute in range(minutes):
            env.reset(seed=minute)
            lines = inner.robot.wire.decoder.lines
            begin = time.monotonic()
            for step in range(STEPS_A_MINUTE):
                if step % STEPS_AN_ACTION == 0:
                    action = rng.uniform(-1.0, 1.0, 2).astype(np.float32)
                *_, done, failed, info = env.step(action)
                if failed:
                    faults += 1
                    stops += info["fault"] == WHEEL
                    print(f"minute {minute + 1}: {info['fault_reason']}", flush=True)
                if done or failed:
                    env.reset()
                    lines = inner.robot.wire.decoder.lines
            gc.collect()
            now = (process.memory_info().rss, len(os.listdir("/proc/self/fd")))  # noqa: PTH208
            first = first or now
            heard = inner.robot.wire.decoder.lines - lines
            refused = sum(inner.robot.wire.decoder.refused.values())
            print(
                f"minute {minute + 1}: {time.monotonic() - begin:.1f} s, {heard} lines, "
                f"{refused} refused, {now[0] / 1e6:.1f} MB, {now[1]} descriptors",
                flush=True,
            )
            faults += refused > 0 or now[0] - first[0] > MOST_GROWTH or now[1] != first[1]
        env.close()
    print(f"false stops of the wheel check: {stops}")
    print("flat" if faults == 0 else f"{faults} faults, or minutes that weren't flat")
    return int(faults > 0)


if __name__ == "__main__":
    sys.exit(main())
