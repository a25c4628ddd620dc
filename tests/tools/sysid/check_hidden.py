"""Identify robots with hidden parameters, and print how many were found: `make identify-check`.

Two of five are outside the model: they have to be refused. Of the others every interval has to hold
the truth. Two robots are identified at a time.

python tests/tools/sysid/check_hidden.py --robots 20              # over pseudo-terminals
python tests/tools/sysid/check_hidden.py --robots 20 --simulated  # in simulated time
"""

from __future__ import annotations

import argparse
import multiprocessing
import subprocess
import sys
import tempfile
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from pathlib import Path
from typing import NamedTuple

sys.path.insert(0, str(Path(__file__).parents[2]))

from sysid_tools import (
    TOLERANCES,
    draw_misfit,
    draw_motors,
    find_missed_truths,
    identify_simulated,
    score_findings,
)

from acsar_gym import RobotConfig, open_link
from acsar_gym.errors import AcsarError
from acsar_gym.tools.sysid.identify import Identification, identify_device

quirk_file = str(Path(__file__).parents[2] / "boards.py")
PATIENT = RobotConfig.preset("acsar").with_(watchdog_timeout=2.0, feedback_timeout=5.0)
"""What is known of the robots, with the patience that a busy machine needs."""
ENOUGH = 0.95
"""Share of the robots of which a parameter must be within its tolerance."""


def identify_emulated(hidden: RobotConfig, *quirks: str) -> Identification:
    """Identify over a pseudo-terminal, whose other end is an emulator in a process of its own."""
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "hidden.yaml"
        hidden.save(file)
        command = [sys.executable, quirk_file, "emulate", "--robot", str(file), "--quirk", *quirks]
        with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as emulator:
            try:
                assert emulator.stdout is not None
                device = emulator.stdout.readline().split()[-1]
                return identify_device(open_link(device, PATIENT), PATIENT, 20.0)
            finally:
                emulator.terminate()


def refuses(result: Identification) -> bool:
    """Whether no file is written."""
    try:
        result.check()
    except AcsarError:
        return True
    return False


class Result(NamedTuple):
    """What was found of a hidden robot."""

    is_outside: bool
    is_good: bool
    misses: set[str]
    """Parameters beyond their tolerances."""
    text: str


def judge(seed: int, *, is_simulated: bool) -> Result:
    """Identify a hidden robot."""
    is_outside = seed % 5 in (2, 4)
    hidden, quirks = draw_misfit(seed) if is_outside else (draw_motors(seed), ())
    identify = identify_simulated if is_simulated else identify_emulated
    result = identify(hidden, *quirks)
    if is_outside:
        return Result(is_outside, refuses(result), set(), f"{quirks}: {result.verdict}")

    missed = find_missed_truths(result, hidden)
    misses = {score.name for score in score_findings(result, hidden) if score.error > 1.0}
    is_good = not missed and not refuses(result)
    return Result(is_outside, is_good, misses, f"{result.held_out} {missed}")


def main() -> int:
    """Print a line for each robot, and the table of hits."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--robots", type=int, default=20)
    parser.add_argument("--simulated", action="store_true")
    arguments = parser.parse_args()

    seeds = range(arguments.robots)
    work = partial(judge, is_simulated=arguments.simulated)
    results = []
    with ProcessPoolExecutor(2, multiprocessing.get_context("spawn")) as pool:
        for seed, result in zip(seeds, pool.map(work, seeds), strict=True):
            print(f"{seed}: {'' if result.is_good else 'MISSED '}{result.text}", flush=True)
            results.append(result)

    inside = [result for result in results if not result.is_outside]
    outside = [result for result in results if result.is_outside]
    written = sum(result.is_good for result in inside)
    refused = sum(result.is_good for result in outside)
    near = {name: sum(name not in result.misses for result in inside) for name in TOLERANCES}
    print(f"within the model: {written} of {len(inside)} written with the truth in every interval")
    print(f"outside of it: {refused} of {len(outside)} refused")
    for name, tolerance in TOLERANCES.items():
        print(f"{name:27} within {tolerance:g}: {near[name]:3} of {len(inside)}")
    is_exact = min(near.values()) >= ENOUGH * len(inside)
    return int(not (is_exact and all(result.is_good for result in results)))


if __name__ == "__main__":
    sys.exit(main())
