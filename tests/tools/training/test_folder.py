"""The folder of a training: a second one, a resumed one, or two at once lose and mix nothing."""

from __future__ import annotations

import hashlib
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
import yaml

from acsar_gym.errors import AcsarError, ConfigError
from acsar_gym.resources import AGENTS
from acsar_gym.tools.training import checkpoints, record, seeds

pytestmark = pytest.mark.xdist_group(__name__)

TINY = ["--robots", "8", "--no-progress", "--threads", "1", "--steps", "256"]
PROGRAM_TIMEOUT = 300.0
"""For a training in another process on a busy machine [s]."""


def digest(out: Path) -> dict[str, str]:
    """All files of a folder with their content."""
    files = (path for path in out.rglob("*") if path.is_file())
    return {str(path): hashlib.sha256(path.read_bytes()).hexdigest() for path in files}


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("finished")
    assert seeds.main([*TINY, "--seed", "1", "--out", str(out)]) == 0
    return out


@pytest.mark.parametrize("more", [[], ["--seeds", "1,2"], ["--algo", "sac", "--seed", "4"]])
def test_a_second_training_of_a_folder_is_refused(finished: Path, more: list[str]) -> None:
    before = digest(finished)
    with pytest.raises(ConfigError) as error:
        seeds.main([*TINY, *more, "--out", str(finished)])
    said = f"holds a finished training: name another folder, or --resume {finished}"
    assert str(error.value) == f"--out {finished}: {said}"
    assert digest(finished) == before


@pytest.mark.parametrize(
    ("files", "said"),
    [
        (["config.yml", "policy.onnx", "model.zip"], "an unfinished training"),
        (["checkpoints/rl_model_256_steps.zip"], "checkpoints"),
        (["policy.onnx"], "policy.onnx"),
        (["learning_curve.csv"], "learning_curve.csv"),
        (["seeds.json"], "trainings of several seeds"),
        (["seed-3/config.yml"], "trainings of several seeds"),
        (["seed-3/log.txt", "notes.txt", ".lock", "tensorboard/PPO_1/events"], None),
    ],
)
def test_whatever_a_training_would_replace_counts(
    files: list[str], said: str | None, tmp_path: Path
) -> None:
    for name in files:
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text("")
    assert record.describe_content(tmp_path) == said
    if said is None:
        with record.claim_folder(tmp_path) as out:
            assert out == tmp_path
    else:
        with pytest.raises(ConfigError, match=f"holds {said}: name another folder"):
            seeds.main([*TINY, "--out", str(tmp_path)])


def test_without_a_name_the_next_number_is_taken(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    assert seeds.main(TINY) == 0
    before = digest(Path("runs/point_goal"))
    assert seeds.main(TINY) == 0
    said = capsys.readouterr().out
    assert f"{Path('runs/point_goal')} is another training's: using runs/point_goal-2\n" in said
    assert "written: runs/point_goal-2/policy.onnx" in said
    assert digest(Path("runs/point_goal")) == before
    with record.claim_folder(Path("runs/point_goal"), numbered=True) as third:
        assert third == Path("runs/point_goal-3")
        with record.claim_folder(Path("runs/point_goal"), numbered=True) as fourth:
            assert fourth == Path("runs/point_goal-4")


def test_a_checkpoint_of_another_training_is_refused(finished: Path, tmp_path: Path) -> None:
    mixed, other = tmp_path / "mixed", tmp_path / "other"
    shutil.copytree(finished, mixed)
    assert seeds.main([*TINY, "--seed", "2", "--steps", "512", "--out", str(other)]) == 0
    names = [path.name for path in checkpoints.find_checkpoints(other / "checkpoints")]
    for name in names:
        shutil.copy(other / "checkpoints" / name, mixed / "checkpoints" / name)
    before = digest(mixed)
    with pytest.raises(ConfigError) as error:
        seeds.main(["--resume", str(mixed), "--trust", "--steps", "1024"])
    said = f"isn't of the training of {mixed / 'config.yml'}: move it elsewhere"
    assert said in str(error.value)
    assert "\n" not in str(error.value)
    assert digest(mixed) == before
    (mixed / "checkpoints" / names[-1]).unlink()
    config = yaml.safe_load((mixed / "config.yml").read_text())
    config["run"]["id"] = "edited"
    (mixed / "config.yml").write_text(yaml.safe_dump(config))
    with pytest.raises(ConfigError, match="isn't of the training of"):
        seeds.main(["--resume", str(mixed), "--trust", "--steps", "1024"])


@pytest.mark.usefixtures("deadline")
def test_the_second_of_two_at_once_is_refused_until_the_first_is_killed(tmp_path: Path) -> None:
    out = tmp_path / "out"
    endless = [*TINY[:-1], "1000000", "--checkpoint-seconds", "0", "--out", str(out)]
    command = [sys.executable, str(AGENTS / "train.py"), *endless]
    with subprocess.Popen(command, stdout=subprocess.DEVNULL) as process:
        until = time.monotonic() + PROGRAM_TIMEOUT
        while not checkpoints.find_checkpoints(out / "checkpoints") and time.monotonic() < until:
            assert process.poll() is None
            time.sleep(0.01)
        for arguments in ([*TINY, "--out", str(out)], ["--resume", str(out), "--trust"]):
            with pytest.raises(AcsarError, match="a training is running in it"):
                seeds.main(arguments)
        process.send_signal(signal.SIGKILL)
    with pytest.raises(ConfigError, match=f"an unfinished training: .*, or --resume {out}"):
        seeds.main([*TINY, "--out", str(out)])
    steps = checkpoints.read_state(checkpoints.find_checkpoints(out / "checkpoints")[-1]).steps
    assert seeds.main(["--resume", str(out), "--trust", "--steps", str(steps + 256)]) == 0
