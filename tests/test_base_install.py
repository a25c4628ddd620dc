"""What a robot's onboard computer installs: the base, without any extra.

Everything but the base is hidden from the interpreter that these tests start.
"""

from __future__ import annotations

import subprocess
import sys
from importlib import metadata

import pytest
from licence_tools import installed_by, normal

LARGE = {"matplotlib", "mujoco", "onnxruntime", "pandas", "pybullet", "scipy", "torch"}
HIDE = """
import sys
class Hidden:
    def find_spec(self, name, path, target=None):
        if name.partition(".")[0] in {hidden!r}:
            raise ModuleNotFoundError("No module named " + name, name=name)
sys.meta_path.insert(0, Hidden())
"""
DRIVE = """
import acsar_gym, gymnasium
with acsar_gym.Robot(acsar_gym.open_link(sys.argv[1])) as robot:
    for _ in range(30):
        robot.drive(0.2, 0.0)
    assert robot.odometry.pose[0] > 0.01
env = gymnasium.make("acsar_gym/PointGoal-v0", link="planar")
env.reset(seed=0)
env.step(env.action_space.sample())
from acsar_gym.tools import commission, teleop
from acsar_gym.tools.commission import board_checks, checks, device, wiring
from acsar_gym.tools.cli import main
sys.argv[1:] = sys.argv[2:]
main()
"""


@pytest.fixture(scope="module")
def hidden() -> list[str]:
    """What can be imported here, but not where only the base is installed."""
    base = installed_by("") | {"acsar-gym"}
    provided = metadata.packages_distributions()
    extra = (name for name, by in provided.items() if base.isdisjoint(map(normal, by)))
    return sorted(name for name in extra if name.isidentifier() and "mypyc" not in name)


def run(hidden: list[str], *arguments: str) -> tuple[int, str, str]:
    """Drive, step, and run a command in an interpreter that has the base alone."""
    program = HIDE.format(hidden=hidden) + DRIVE
    done = subprocess.run(
        [sys.executable, "-c", program, *arguments],
        capture_output=True,
        text=True,
        check=False,
        timeout=120,
    )
    return done.returncode, done.stdout, done.stderr


def test_base_has_no_simulator_and_no_torch() -> None:
    assert installed_by("").isdisjoint(LARGE)


def test_base_drives_over_a_serial_device(hidden: list[str], shared_device: str) -> None:
    assert {"scipy", "pytest"} <= set(hidden)
    code, out, err = run(hidden, shared_device, "doctor", shared_device)
    assert (code, err) == (0, "")
    assert "100 expected" in out


@pytest.mark.parametrize(
    ("command", "said"),
    [
        ("evaluate --link planar", "running a policy: deploy"),
        ("benchmark --sets open --agents turn_drive", "a benchmark: scipy"),
        ("identify DEVICE", "identification: scipy"),
        ("drive --link bullet --duration 1", "the PyBullet robot: bullet"),
    ],
)
@pytest.mark.slow
def test_base_names_a_missing_extra_in_one_line(hidden: list[str], command: str, said: str) -> None:
    feature, extra = said.split(": ")
    code, _, err = run(hidden, "planar", *command.split())
    command = f"pip install --constraint constraints.txt '.[{extra}]'"
    assert err == f"acsar-gym: {feature} needs an extra, in the checkout: {command}\n"
    assert code == 2
