"""Trainings that go on: after SIGKILL at the last checkpoint, or refused in one line."""

from __future__ import annotations

import contextlib
import csv
import gc
import pickle
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest
import yaml
from disk_tools import full_disk

from acsar_gym.errors import AcsarError
from acsar_gym.resources import AGENTS
from acsar_gym.tools.policies import OnnxPolicy
from acsar_gym.tools.training import checkpoints, record, seeds
from acsar_gym.tools.training.checkpoints import TrainingState
from acsar_gym.tools.training.plan import TrainingPlan

pytestmark = pytest.mark.xdist_group(__name__)

STEPS = 2048
"""Eight rollouts."""
PATIENCE = 300.0
"""For a subprocess on a busy machine [s]."""
TINY = ["--robots", "8", "--no-progress", "--threads", "1", "--checkpoint-seconds", "0"]


def curve(folder: Path) -> list[dict[str, str]]:
    """The learning curve without its times."""
    with (folder / "learning_curve.csv").open() as file:
        return [{k: v for k, v in row.items() if k != "seconds"} for row in csv.DictReader(file)]


def killed(arguments: list[str], out: Path) -> None:
    """A training that was killed once it had written a checkpoint."""
    command = [sys.executable, str(AGENTS / "train.py"), *arguments, "--out", str(out)]
    with subprocess.Popen(command, stdout=subprocess.DEVNULL) as process:
        until = time.monotonic() + PATIENCE
        while not checkpoints.find_checkpoints(out / "checkpoints") and time.monotonic() < until:
            assert process.poll() is None
            time.sleep(0.01)
        process.send_signal(signal.SIGKILL)
    assert checkpoints.find_checkpoints(out / "checkpoints")
    assert not (out / "model.zip").exists()


@pytest.mark.parametrize(
    "algo",
    ["ppo", *(pytest.param(name, marks=pytest.mark.slow) for name in ("sac", "tqc", "ppo_lstm"))],
)
def test_a_killed_training_goes_on_at_its_last_checkpoint(algo: str, tmp_path: Path) -> None:
    arguments = [*TINY, "--steps", str(STEPS), "--seed", "7", "--algo", algo]
    killed([*arguments, "--learning-rate", "0.003"], tmp_path)
    newest = checkpoints.find_checkpoints(tmp_path / "checkpoints")[-1]
    before, begun = checkpoints.read_state(newest), curve(tmp_path)
    assert 0 < before.steps < STEPS
    assert seeds.main(["--resume", str(tmp_path), "--trust"]) == 0
    assert curve(tmp_path)[: len(begun)] == begun
    told = yaml.safe_load((tmp_path / "config.yml").read_text())
    assert told["acsar_gym/PointGoal-v0"]["learning_rate"] == 0.003
    assert (told["run"]["steps"], len(told["run"]["commands"])) == (STEPS, 2)
    assert told["run"]["seconds"] > before.seconds
    bundle = OnnxPolicy(tmp_path / "policy.onnx").bundle
    assert bundle.training is not None
    assert bundle.training.seed == 7


def test_rewards_are_normalized_as_before(tmp_path: Path) -> None:
    from stable_baselines3.common.vec_env import VecNormalize

    recipe, out = tmp_path / "mine.yml", tmp_path / "out"
    given = {"n_timesteps": 512, "n_steps": 32, "batch_size": 64, "normalize": True}
    recipe.write_text(yaml.safe_dump({"default": given}))
    assert seeds.main([*TINY, "--conf-file", str(recipe), "--out", str(out)]) == 0
    file = out / "checkpoints" / "vecnormalize.pkl"
    before = pickle.loads(file.read_bytes())  # noqa: S301 - of this test
    assert isinstance(before, VecNormalize)
    assert seeds.main(["--resume", str(out), "--trust", "--steps", "768"]) == 0
    after = pickle.loads(file.read_bytes())  # noqa: S301
    assert after.ret_rms.count == pytest.approx(before.ret_rms.count + 256)


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a training of 256 steps."""
    out = tmp_path_factory.mktemp("finished")
    assert seeds.main([*TINY, "--steps", "256", "--out", str(out)]) == 0
    return out


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        ("", "pass --trust"),
        ("--trust", "its 256 steps are done: ask for more with --steps"),
        ("--trust --algo sac", "--algo sac: {} is of a training with ppo"),
        ("--trust --env barn", "--env barn: {} is of a training with point_goal"),
        ("--trust --seed 3", "--seed 3: {} is of a training with 0"),
    ],
)
def test_a_folder_is_refused_in_one_line(finished: Path, arguments: str, said: str) -> None:
    with pytest.raises(AcsarError) as error:
        seeds.main(["--resume", str(finished), *arguments.split()])
    assert said.format(finished) in str(error.value)
    assert "\n" not in str(error.value)


def test_a_folder_of_something_else_is_refused(finished: Path, tmp_path: Path) -> None:
    resumed = ["--resume", str(tmp_path), "--trust"]
    with pytest.raises(AcsarError, match=r"config\.yml"):
        seeds.main(resumed)
    assert not list(tmp_path.iterdir())
    (tmp_path / "config.yml").write_text("run: 3\n")
    with pytest.raises(AcsarError, match="not of 'acsar-gym train'"):
        seeds.main(resumed)
    (tmp_path / "seed-0").mkdir()
    (tmp_path / "seed-0" / "config.yml").write_text("")
    with pytest.raises(AcsarError, match="trainings of several seeds: name one, such as"):
        seeds.main(resumed)
    with pytest.raises(AcsarError, match="goes on in its own folder: leave it out"):
        seeds.main(["--resume", str(finished), "--trust", "--out", str(tmp_path / "new")])


def test_an_edited_config_and_a_cut_checkpoint_are_refused(finished: Path, tmp_path: Path) -> None:
    shutil.copytree(finished, tmp_path / "copy")
    resumed = ["--resume", str(tmp_path / "copy"), "--trust", "--steps", "512"]
    (tmp_path / "copy/checkpoints/rl_model_300_steps.zip").write_bytes(b"PK")
    with pytest.raises(
        AcsarError, match=r"rl_model_300_steps\.zip.*: delete it to go on from the one before"
    ):
        seeds.main(resumed)
    config = tmp_path / "copy" / "config.yml"
    config.write_text(config.read_text().replace("robots: 8", "robots: many"))
    with pytest.raises(AcsarError, match=r"train\.robots = 'many'"):
        seeds.main(resumed)


@pytest.mark.slow
def test_more_steps_go_on_in_the_same_folder(
    finished: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert seeds.main(["--resume", str(finished), "--trust", "--steps", "512"]) == 0
    assert "going on at 256 steps, with new episodes\n" in capsys.readouterr().out
    assert [path.name for path in checkpoints.find_checkpoints(finished / "checkpoints")] == [
        "rl_model_256_steps.zip",
        "rl_model_512_steps.zip",
    ]
    config = yaml.safe_load((finished / "config.yml").read_text())
    assert config["run"]["versions"]["acsar_gym"]
    assert config["run"]["cores"] >= 1
    assert (finished / "learning_curve.png").read_bytes().startswith(b"\x89PNG")


@pytest.mark.slow
def test_a_policy_for_which_there_was_no_room_is_written_by_resume(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The policy is a device that is always full; all steps are done."""
    policy = tmp_path / "policy.onnx"
    begin = record.begin_record

    def begin_and_link(plan: TrainingPlan) -> dict[str, Any]:
        policy.symlink_to("/dev/full")
        return begin(plan)

    with monkeypatch.context() as patch:
        patch.setattr(record, "begin_record", begin_and_link)
        with pytest.raises(AcsarError, match=f"go on with --resume {tmp_path} --trust"):
            seeds.main([*TINY, "--steps", "256", "--out", str(tmp_path)])
    before = curve(tmp_path)
    policy.unlink()
    assert seeds.main(["--resume", str(tmp_path), "--trust"]) == 0
    assert len(policy.read_bytes()) > 1000
    assert curve(tmp_path) == before
    again = ["--resume", str(tmp_path), "--trust"]
    with pytest.raises(AcsarError, match="its 256 steps are done"):
        seeds.main(again)
    policy.unlink()
    assert seeds.main(again) == 0
    assert policy.exists()


@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
def test_a_full_disk_leaves_the_last_checkpoint(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write, folder = checkpoints.write_checkpoint, tmp_path / "checkpoints"

    def write_until_full(to: Path, model: Any, state: TrainingState) -> Path:
        with full_disk(1000) if state.steps == 512 else contextlib.nullcontext():
            return write(to, model, state)

    monkeypatch.setattr(checkpoints, "write_checkpoint", write_until_full)
    with pytest.raises(AcsarError) as error:
        seeds.main([*TINY, "--steps", "768", "--out", str(tmp_path)])
    said = str(error.value)
    del error
    gc.collect()  # the file that stable-baselines3 leaves open: here, not in a later test
    assert said.startswith(f"--out {tmp_path}: can't be written: File too large; ")
    assert f"{folder / 'rl_model_256_steps.zip'} is whole" in said
    assert "\n" not in said
    assert [path.name for path in folder.iterdir()] == ["rl_model_256_steps.zip"]
    assert checkpoints.read_state(folder / "rl_model_256_steps.zip").steps == 256
