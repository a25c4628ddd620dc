"""Identify robots with hidden parameters, and print how many were found: `make identify-check`.

python tests/tools/sysid/check_hidden.py --robots 20              # over pseudo-terminals
python tests/tools/sysid/check_hidden.py --robots 20 --simulated  # in simulated time
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import tempfile
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[2]))

from sysid_tools import TOLERANCES, Score, draw_motors, score_findings

from acsar_gym import RobotConfig, open_link
from acsar_gym.tools.sysid.identify import Identification, identify_device

PATIENT = RobotConfig.preset("acsar").with_(watchdog_timeout=2.0, feedback_timeout=5.0)
"""What is known of the robots, with the patience that a busy machine needs."""
ENOUGH, HELD = 0.95, 0.90
"""Shares of the robots that must be found, and held by their intervals."""


def simulated(hidden: RobotConfig, duration: float) -> Identification:
    """Identify in simulated time."""
    return identify_device(open_link("planar", hidden), RobotConfig.preset("acsar"), duration)


def emulated(hidden: RobotConfig, duration: float) -> Identification:
    """Identify over a pseudo-terminal, whose other end is an emulator in a process of its own."""
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "hidden.yaml"
        hidden.save(file)
        command = [sys.executable, "-m", "acsar_gym", "emulate", "--robot", str(file)]
        with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as emulator:
            try:
                assert emulator.stdout is not None
                device = emulator.stdout.readline().split()[-1]
                return identify_device(open_link(device, PATIENT), PATIENT, duration)
            finally:
                emulator.terminate()


def rounds(arguments: argparse.Namespace) -> Iterator[list[Score]]:
    """Identify one robot after the other."""
    for seed in range(arguments.seed, arguments.seed + arguments.robots):
        hidden = draw_motors(seed)
        way = simulated if arguments.simulated else emulated
        found = list(score_findings(way(hidden, arguments.duration), hidden))
        line = "  ".join(
            f"{one.name.split('.')[1]} {one.error:.2f} ({one.share:.2f}{'' if one.holds else '!'})"
            for one in found
        )
        print(f"{seed}: {line}", flush=True)
        yield found


def main() -> int:
    """Print errors as shares of the tolerances, and the table of hits."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--robots", type=int, default=20)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--duration", type=float, default=20.0)
    parser.add_argument("--simulated", action="store_true")
    arguments = parser.parse_args()
    found: dict[str, int] = defaultdict(int)
    held: dict[str, int] = defaultdict(int)
    for robot in rounds(arguments):
        for one in robot:
            found[one.name] += one.error <= 1.0
            held[one.name] += one.holds
    enough = True
    for name, tolerance in TOLERANCES.items():
        n = arguments.robots
        print(
            f"{name:27} within {tolerance:g}: {found[name]:3} of {n}, held: {held[name]:3} of {n}"
        )
        enough &= found[name] >= ENOUGH * n and held[name] >= HELD * n
    return 0 if enough else 1


if __name__ == "__main__":
    sys.exit(main())
