"""agents/train.py: the real script on a tiny budget."""

from __future__ import annotations

import signal
import subprocess
import sys
from pathlib import Path

import psutil
import pytest
from serial_tools import CLI, TIMEOUT

import acsar_gym
from acsar_gym import RobotConfig
from acsar_gym.resources import AGENTS
from acsar_gym.tools.training import seeds

pytestmark = pytest.mark.xdist_group(__name__)

MAIN = Path(acsar_gym.__file__).with_name("__main__.py")
WITHOUT = """
import runpy, sys

class Hidden:
    def find_spec(self, name, path, target=None):
        if name == hidden:
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)

hidden = sys.argv.pop(1)
sys.meta_path.insert(0, Hidden())
runpy.run_path(sys.argv.pop(1), run_name="__main__")
"""
"""Runs the program in argv[2] where the module in argv[1] isn't installed."""


@pytest.mark.parametrize(
    ("module", "program"),
    [("torch", f"{MAIN} train"), ("onnxscript", f"{MAIN} train"), ("torch", f"{AGENTS}/train.py")],
)
def test_a_missing_extra_is_named(module: str, program: str) -> None:
    command = [sys.executable, "-c", WITHOUT, module, *program.split()]
    done = subprocess.run(command, capture_output=True, text=True, timeout=TIMEOUT, check=False)
    wanted = "acsar-gym: training needs an extra: pip install 'acsar_gym[train]'\n"
    assert (done.returncode, done.stderr) == (2, wanted)


def test_sigterm_saves_what_there_is(tmp_path: Path) -> None:
    command = [*CLI, "train", "--steps", "100000000", "--robots", "16", "--out", str(tmp_path)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        try:
            assert process.stdout is not None
            assert process.stdout.readline().startswith("training on an open floor, held out: ")
            assert "held-out success" in process.stdout.readline()
            started = psutil.Process(process.pid).children(recursive=True)
            process.send_signal(signal.SIGTERM)
            said = process.stdout.read().splitlines()
            process.wait(TIMEOUT)
        finally:
            process.kill()
        assert process.returncode == 128 + signal.SIGTERM
    assert started == []
    assert [line.split(" ")[0] for line in said if line and "held-out" not in line] == [
        "interrupted",
        "written:",
    ]
    assert (tmp_path / "policy.onnx").stat().st_size > 1000
    assert (tmp_path / "model.zip").stat().st_size > 1000


def test_a_training_says_how_good_it_is_and_what_comes_next(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    options = ["--steps", "1", "--robots", "4", "--no-progress", "--out", str(tmp_path)]
    assert seeds.main([*options, "--threads", "1", "--seed", "3"]) == 0
    begin, written, score, following = capsys.readouterr().out.splitlines()
    assert begin == "training on an open floor, held out: other seeds; 1 thread, seed 3"
    assert written.startswith(f"written: {tmp_path / 'policy.onnx'}")
    assert score.startswith("held-out success: ")
    assert " of 64 episodes" in score
    assert following == f"next: acsar-gym evaluate --policy {tmp_path / 'policy.onnx'}"
    for name in ("policy.onnx", "model.zip", "tensorboard"):
        assert (tmp_path / name).exists()
    assert [path.name for path in tmp_path.glob(".*")] == [".lock"]


def test_a_training_says_which_ranges_were_measured(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    lag = {"low": 0.1, "high": 0.12, "method": "identify"}
    robot = RobotConfig.preset("acsar").with_(
        motor={"time_constant": 0.11},
        firmware={"delay_samples": [0.001, 0.004]},
        measured={"motor.time_constant": lag},
        motor_fit="doesn't fit: saturates at 6.0 rad/s",
    )
    robot.save(tmp_path / "robot.yaml")
    options = ["--steps", "1", "--robots", "4", "--no-progress", "--threads", "1"]
    options += ["--robot", str(tmp_path / "robot.yaml")]
    assert seeds.main([*options, "--out", str(tmp_path / "measured")]) == 0
    told, misfit, *_ = capsys.readouterr().out.splitlines()
    assert misfit.endswith(
        "robot.yaml: this robot's simulation doesn't fit: saturates at 6.0 rad/s"
    )
    found = "motor_lag 0.909 to 1.09, delay_samples (2 delays up to 0.004 s)"
    assert f"seed 0; randomized as measured: {found}; by default widths: friction" in told
    assert seeds.main([*options, "--no-randomize", "--out", str(tmp_path / "nominal")]) == 0
    assert "randomized" not in capsys.readouterr().out
