"""Identify robots with hidden parameters, and print how many were found: `make identify-check`.

Two of five are outside the model: they have to be named and refused. Of the others every interval
has to hold the truth.

python tests/tools/sysid/check_hidden.py --robots 20              # over pseudo-terminals
python tests/tools/sysid/check_hidden.py --robots 20 --simulated  # in simulated time
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import tempfile
from collections import Counter
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[2]))

from quirks import apply_to_config, make_link, parse_quirks
from sysid_tools import TOLERANCES, draw_misfit, draw_motors, find_missed_truths, score_findings

from acsar_gym import RobotConfig, open_link
from acsar_gym.errors import AcsarError
from acsar_gym.tools.sysid.identify import Identification, identify_device

quirk_file = str(Path(__file__).parents[2] / "quirks.py")
PATIENT = RobotConfig.preset("acsar").with_(watchdog_timeout=2.0, feedback_timeout=5.0)
"""What is known of the robots, with the patience that a busy machine needs."""
ENOUGH = 0.95
"""Share of the robots of which a parameter must be within its tolerance."""


def simulated(hidden: RobotConfig, quirks: tuple[str, ...], duration: float) -> Identification:
    """Identify in simulated time."""
    odd = parse_quirks(quirks)
    link = make_link("planar", apply_to_config(odd, hidden), odd)
    return identify_device(link, RobotConfig.preset("acsar"), duration)


def emulated(hidden: RobotConfig, quirks: tuple[str, ...], duration: float) -> Identification:
    """Identify over a pseudo-terminal, whose other end is an emulator in a process of its own."""
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "hidden.yaml"
        hidden.save(file)
        command = [sys.executable, quirk_file, "emulate", "--robot", str(file), "--quirk", *quirks]
        with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as emulator:
            try:
                assert emulator.stdout is not None
                device = emulator.stdout.readline().split()[-1]
                return identify_device(open_link(device, PATIENT), PATIENT, duration)
            finally:
                emulator.terminate()


def refuses(found: Identification) -> bool:
    """Whether no file is written."""
    try:
        found.check()
    except AcsarError:
        return True
    return False


def main() -> int:
    """Print a line for each robot, and the table of hits."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--robots", type=int, default=20)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--duration", type=float, default=20.0)
    parser.add_argument("--simulated", action="store_true")
    arguments = parser.parse_args()
    identify = simulated if arguments.simulated else emulated
    inside = outside = written = refused = 0
    near: Counter[str] = Counter()
    for number in range(arguments.robots):
        seed = arguments.seed + number
        if number % 5 in (2, 4):
            hidden, quirks, said = draw_misfit(seed)
            found = identify(hidden, quirks, arguments.duration)
            assert found.model is not None
            good = refuses(found) and said in found.model.pattern
            print(f"{seed}: {'' if good else 'MISSED '}{quirks}: {found.model}", flush=True)
            outside, refused = outside + 1, refused + good
            continue
        hidden = draw_motors(seed)
        found = identify(hidden, (), arguments.duration)
        missed = find_missed_truths(found, hidden)
        scores = list(score_findings(found, hidden))
        near.update(one.name for one in scores if one.error <= 1.0)
        good = not missed and not refuses(found)
        print(f"{seed}: {'' if good else 'MISSED '}{found.model} {missed}", flush=True)
        inside, written = inside + 1, written + good
    print(f"within the model: {written} of {inside} written with the truth in every interval")
    print(f"outside of it: {refused} of {outside} named and refused")
    for name, tolerance in TOLERANCES.items():
        print(f"{name:27} within {tolerance:g}: {near[name]:3} of {inside}")
    exact = all(near[name] >= ENOUGH * inside for name in TOLERANCES)
    return 0 if exact and written == inside and refused == outside else 1


if __name__ == "__main__":
    sys.exit(main())
