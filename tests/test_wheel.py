"""The built wheel, installed into an empty environment outside the checkout: what users have."""

from __future__ import annotations

import os
import subprocess
import sys
import venv
from pathlib import Path

import pytest

pytestmark = pytest.mark.xdist_group(__name__)

ROOT = Path(__file__).resolve().parents[1]
HANGS = 900.0
"""A command that takes longer hangs [s]. One may have to compile for minutes."""
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
    return interpreter


def test_wheel_steps_envs_outside_the_checkout(python: Path, tmp_path: Path) -> None:
    done = subprocess.run(
        [str(python), "-c", STEP],
        cwd=tmp_path,
        env={name: value for name, value in os.environ.items() if name != "PYTHONPATH"},
        capture_output=True,
        text=True,
        check=True,
        timeout=HANGS,
    )
    for path in done.stdout.splitlines():
        assert "site-packages" in path
        assert not path.startswith(str(ROOT))
