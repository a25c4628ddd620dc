"""The built wheel, installed into an empty environment outside the checkout: what users have."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import venv
from pathlib import Path

import pytest

from acsar_gym.recording import read
from acsar_gym.tools import warm_up
from acsar_gym.tools.policies import OnnxPolicy

pytestmark = pytest.mark.xdist_group(__name__)

ROOT = Path(__file__).resolve().parents[1]
HANGS = 900.0
"""A command that takes longer hangs [s]; one may have to compile for minutes."""
STEP = """
import gymnasium, pathlib, sys
for link in ("planar", "bullet", "mujoco"):
    env = gymnasium.make("acsar_gym:acsar_gym/PointGoal-v0", link=link)
    env.reset(seed=0)
    env.step(env.action_space.sample())
    env.close()
import acsar_gym
from acsar_gym.tools.policies import resolve
from acsar_gym.resources import AGENTS
assert (AGENTS / "train.py").exists()
print(acsar_gym.__file__, resolve("point_goal"), sep="\\n")
"""


@pytest.fixture(scope="module")
def python(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An interpreter that sees the wheel and our dependencies, but not the checkout."""
    folder = tmp_path_factory.mktemp("wheel")
    pip = [sys.executable, "-m", "pip", "--quiet", "--disable-pip-version-check"]
    offline = ["--no-deps", "--no-index"]
    build = [*pip, "wheel", *offline, "--no-build-isolation", "-w", str(folder), str(ROOT)]
    subprocess.run(build, check=True, timeout=HANGS)
    venv.create(folder / "env", with_pip=False)
    interpreter = folder / "env" / "bin" / "python"
    (wheel,) = folder.glob("*.whl")
    install = [*pip, "--python", str(interpreter), "install", *offline, str(wheel)]
    subprocess.run(install, check=True, timeout=HANGS)
    site = next((folder / "env").glob("lib/python*/site-packages"))
    (site / "dependencies.pth").write_text(
        "".join(f"{place}\n" for place in sys.path if place.endswith("site-packages"))
    )
    # Spares the wheel a minute of compiling: code with another stamp isn't used.
    warm_up.warm_env("point_goal")
    for kept in (ROOT / "acsar_gym").glob("**/__pycache__/*.nb[ic]"):
        place = site / "acsar_gym" / kept.relative_to(ROOT / "acsar_gym")
        place.parent.mkdir(exist_ok=True)
        shutil.copyfile(kept, place)
    return interpreter


def run(*command: str | Path, folder: Path) -> str:
    """Run a program in the user's folder; returns what it prints."""
    away = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    done = subprocess.run(
        command, cwd=folder, env=away, capture_output=True, text=True, check=False, timeout=HANGS
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_envs_step_outside_the_checkout(python: Path, tmp_path: Path) -> None:
    for path in run(python, "-c", STEP, folder=tmp_path).splitlines():
        assert "site-packages" in path
        assert not path.startswith(str(ROOT))


def test_a_policy_is_trained_evaluated_recorded_and_compared(python: Path, tmp_path: Path) -> None:
    def acsar_gym(line: str) -> str:
        return run(python.parent / "acsar-gym", *line.split(), folder=tmp_path)

    said = acsar_gym("train --steps 8000 --robots 256 --threads 1 --no-progress --out run")
    assert "written: run/policy.onnx (to drive with), run/model.zip (to train on)" in said
    bundle = OnnxPolicy(tmp_path / "run" / "policy.onnx").bundle
    assert bundle is not None
    assert bundle.training is not None
    assert (bundle.training.revision, bundle.training.steps) == ("", 8192)
    said = acsar_gym(
        "evaluate --policy run/policy.onnx --link planar --episodes 2 --record drives.mcap"
    )
    assert "/2 (" in said
    assert len(read(tmp_path / "drives.mcap").episodes) == 2
    acsar_gym("run 0.5 0 --policy point_goal --record drive.mcap")
    assert "drive.mcap: whole; 1 episode" in acsar_gym("record info drive.mcap")
    acsar_gym(
        "benchmark --env point_goal --sets open/acsar --links planar --conditions nominal "
        "--scenes 3 --agents packaged turn_drive --out bench"
    )
