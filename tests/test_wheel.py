"""The built wheel, installed into an empty environment outside the checkout."""

from __future__ import annotations

import subprocess
import sys
import sysconfig
import venv
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
STEP = """
import gymnasium, pathlib, sys
for link in ("planar", "bullet"):
    env = gymnasium.make("acsar_gym:acsar_gym/PointGoal-v0", link=link)
    env.reset(seed=0)
    env.step(env.action_space.sample())
    env.close()
import acsar_gym
from acsar_gym.policies import resolve
from acsar_gym.resources import AGENTS
assert (AGENTS / "train.py").exists()
from acsar_gym import baselines
law = sys.modules[type(baselines.load("navfn", "acsar_gym/Barn-v1")).__module__]
print(acsar_gym.__file__, resolve("point_goal"), law.__file__, sep="\\n")
"""


@pytest.fixture(scope="module")
def python(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An interpreter that sees the wheel and our dependencies, but not the checkout."""
    folder = tmp_path_factory.mktemp("wheel")
    pip = [sys.executable, "-m", "pip", "--quiet", "--disable-pip-version-check"]
    offline = ["--no-deps", "--no-index"]
    build = [*pip, "wheel", *offline, "--no-build-isolation", "-w", str(folder), str(ROOT)]
    subprocess.run(build, check=True, timeout=120)
    venv.create(folder / "env", with_pip=False)
    interpreter = folder / "env" / "bin" / "python"
    (wheel,) = folder.glob("*.whl")
    install = [*pip, "--python", str(interpreter), "install", *offline, str(wheel)]
    subprocess.run(install, check=True, timeout=120)
    site = next((folder / "env").glob("lib/python*/site-packages"))
    (site / "dependencies.pth").write_text(sysconfig.get_path("purelib") + "\n")
    return interpreter


def test_envs_step_outside_the_checkout(python: Path, tmp_path: Path) -> None:
    done = subprocess.run(
        [str(python), "-c", STEP],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        check=True,
        timeout=120,
    )
    for path in done.stdout.splitlines():
        assert "site-packages" in path
        assert not path.startswith(str(ROOT))


def test_the_command_runs_outside_the_checkout(python: Path, tmp_path: Path) -> None:
    command = [str(python.parent / "acsar-gym"), "evaluate", "--link", "planar", "--episodes", "2"]
    done = subprocess.run(
        command, cwd=tmp_path, capture_output=True, text=True, check=True, timeout=120
    )
    assert "2/2" in done.stdout


def test_the_training_script_is_found_outside_the_checkout(python: Path, tmp_path: Path) -> None:
    command = [str(python.parent / "acsar-gym"), "train", "--seed", "-1"]
    done = subprocess.run(
        command, cwd=tmp_path, capture_output=True, text=True, check=False, timeout=120
    )
    assert (done.returncode, done.stderr[:23]) == (2, "acsar-gym: --seed -1: m")
