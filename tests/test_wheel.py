"""The built wheel, installed into an empty environment outside the checkout: what users have."""

from __future__ import annotations

import shutil
import subprocess
import sys
import venv
from collections.abc import Callable
from pathlib import Path

import pytest
import yaml

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
from acsar_gym.tools import baselines
law = sys.modules[type(baselines.load_baseline("navfn", "acsar_gym/Barn-v1")).__module__]
print(acsar_gym.__file__, resolve("point_goal"), law.__file__, sep="\\n")
"""
Command = Callable[..., str]


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
    _copy_compiled_code(site / "acsar_gym")
    return interpreter


def _copy_compiled_code(package: Path) -> None:
    """Spare the wheel a minute of compiling: the checkout's sources, so its stamps, are the same.

    Code with another stamp isn't used.
    """
    warm_up.warm_env("point_goal")
    for kept in (ROOT / "acsar_gym").glob("**/__pycache__/*.nb[ic]"):
        place = package / kept.relative_to(ROOT / "acsar_gym")
        place.parent.mkdir(exist_ok=True)
        shutil.copyfile(kept, place)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The user's folder, in which all commands run."""
    return tmp_path_factory.mktemp("user")


@pytest.fixture(scope="module")
def acsar_gym(python: Path, folder: Path) -> Command:
    """`acsar_gym("evaluate", ...)` runs the wheel's own script; returns what it prints."""

    def run(*arguments: str) -> str:
        done = subprocess.run(
            [str(python.parent / "acsar-gym"), *arguments],
            cwd=folder,
            capture_output=True,
            text=True,
            check=False,
            timeout=HANGS,
        )
        assert done.returncode == 0, done.stderr
        return done.stdout

    return run


@pytest.fixture(scope="module")
def trained(acsar_gym: Command, folder: Path) -> str:
    """What 8,000 steps of training print; they leave the folder "run"."""
    options = ["--steps", "8000", "--robots", "256", "--threads", "1", "--no-progress"]
    return acsar_gym("train", *options, "--out", "run")


def test_envs_step_outside_the_checkout(python: Path, tmp_path: Path) -> None:
    done = subprocess.run(
        [str(python), "-c", STEP],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        check=True,
        timeout=HANGS,
    )
    for path in done.stdout.splitlines():
        assert "site-packages" in path
        assert not path.startswith(str(ROOT))


def test_a_training_leaves_a_policy_and_a_model(trained: str, folder: Path) -> None:
    assert "written: run/policy.onnx (to drive with), run/model.zip (to train on)" in trained
    assert (folder / "run" / "model.zip").stat().st_size > 1000
    bundle = OnnxPolicy(folder / "run" / "policy.onnx").bundle
    assert bundle is not None
    assert bundle.training is not None
    assert (bundle.training.revision, bundle.training.steps) == ("", 8192)
    run = yaml.safe_load((folder / "run" / "config.yml").read_text("utf-8"))["run"]
    assert (run["revision"], run["finished"]) == (None, True)


def test_the_policy_is_evaluated_and_its_drives_recorded(
    acsar_gym: Command, folder: Path, trained: str
) -> None:
    options = ["--policy", "run/policy.onnx", "--link", "planar", "--episodes", "2"]
    said = acsar_gym("evaluate", *options, "--record", "drives.mcap")
    assert "/2 (" in said
    drives = read(folder / "drives.mcap")
    assert (len(drives.episodes), drives.cut, drives.dropped) == (2, False, 0)


def test_a_packaged_policy_drives_in_pybullet_and_the_drive_is_recorded(acsar_gym: Command) -> None:
    acsar_gym("run", "0.5", "0", "--policy", "point_goal", "--record", "drive.mcap")
    assert "drive.mcap: whole; 1 episode" in acsar_gym("record", "info", "drive.mcap")


def test_three_scenes_of_the_benchmark(acsar_gym: Command, folder: Path) -> None:
    cell = [
        "--env",
        "point_goal",
        "--sets",
        "open/acsar",
        "--links",
        "planar",
        "--conditions",
        "nominal",
        "--scenes",
        "3",
    ]
    table = acsar_gym("benchmark", *cell, "--agents", "packaged", "turn_drive", "--out", "bench")
    assert {"packaged", "turn_drive"} <= set(table.split())
