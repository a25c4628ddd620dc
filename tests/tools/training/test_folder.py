"""The folder of a training: new, resumed, of several seeds, and on a full disk."""

from __future__ import annotations

import contextlib
import csv
import gc
import shutil
from pathlib import Path
from typing import Any

import pytest
import yaml
from disk_tools import full_disk
from policy_tools import save, tiny

from acsar_gym.errors import AcsarError, ConfigError
from acsar_gym.tools.policies import OnnxPolicy
from acsar_gym.tools.training import callbacks, folders
from acsar_gym.tools.training.options import TrainingOptions
from acsar_gym.tools.training.run import train
from acsar_gym.tools.training.seeds import parse_seeds, train_seeds

pytestmark = pytest.mark.xdist_group(__name__)

STEPS = 2048
"""Eight rollouts."""


def contents(out: Path) -> dict[Path, bytes]:
    """All files of a folder with their content."""
    return {path: path.read_bytes() for path in out.rglob("*") if path.is_file()}


def curve(folder: Path) -> list[dict[str, str]]:
    """The learning curve without its times."""
    with (folder / "learning_curve.csv").open() as file:
        return [{k: v for k, v in row.items() if k != "seconds"} for row in csv.DictReader(file)]


def resume(folder: Path, **options: Any) -> Any:
    return train(TrainingOptions(resume=folder, trust=True, **options))


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a training of 256 steps."""
    out = tmp_path_factory.mktemp("finished")
    train(tiny(out, steps=256))
    return out


def test_make_folder_refuses_a_folder_that_is_not_empty(finished: Path) -> None:
    files = contents(finished)
    for run, options in ((train, {}), (train_seeds, {"seeds": "1,2"})):
        with pytest.raises(ConfigError, match=f"isn't empty: .*--resume {finished}"):
            run(tiny(finished, steps=256, **options))
    assert contents(finished) == files
    with pytest.raises(ConfigError, match="another training has it"):  # made at the same time
        folders.begin_config(finished, "x", {}, tiny(finished))


def test_make_folder_takes_the_next_number(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    for number in (1, 2, 3):
        assert folders.make_folder(None, "point_goal") == Path(f"runs/point_goal/{number}")


@pytest.mark.parametrize("ending", [KeyboardInterrupt, MemoryError])
@pytest.mark.parametrize(
    "algo",
    ["ppo", *(pytest.param(name, marks=pytest.mark.slow) for name in ("sac", "tqc", "ppo_lstm"))],
)
def test_resume_goes_on_at_the_newest_model(
    algo: str, ending: type[BaseException], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """At model.zip after Ctrl-C, at the last checkpoint after an end that saves nothing."""
    on_rollout_end = callbacks.TrainingWatch._on_rollout_end

    def end(self: callbacks.TrainingWatch) -> None:
        if self.num_timesteps > STEPS // 2:
            raise ending
        on_rollout_end(self)

    with monkeypatch.context() as patch, pytest.raises(ending):
        patch.setattr(callbacks.TrainingWatch, "_on_rollout_end", end)
        options = tiny(
            tmp_path, algo=algo, steps=STEPS, seed=7, learning_rate=0.003, checkpoint_seconds=0.0
        )
        train(options)
    newest = folders.find_models(tmp_path)[0]
    steps = folders.count_steps(newest)
    assert 0 < steps < STEPS
    assert (newest.name == "model.zip") == (ending is KeyboardInterrupt)
    rows = [row for row in curve(tmp_path) if int(row["steps"]) <= steps]
    (tmp_path / "checkpoints" / "rl_model_9999_steps.zip").write_bytes(b"PK")  # cut

    assert resume(tmp_path).score.steps == STEPS
    assert curve(tmp_path)[: len(rows)] == rows
    assert int(curve(tmp_path)[-1]["steps"]) == STEPS
    config = yaml.safe_load((tmp_path / "config.yml").read_text())
    assert config["acsar_gym/PointGoal-v0"]["learning_rate"] == 0.003
    assert OnnxPolicy(tmp_path / "policy.onnx").document.training["seed"] == 7


def test_resume_refuses_other_options_and_folders(finished: Path, tmp_path: Path) -> None:
    with pytest.raises(AcsarError, match="pass --trust"):
        train(TrainingOptions(resume=finished))
    for start, message in ((finished / "model.zip", "pass --trust"), (tmp_path / "no", "no such")):
        with pytest.raises(AcsarError, match=message):
            train(tiny(tmp_path / "new", resume=start))
    assert not (tmp_path / "new").exists()
    with pytest.raises(AcsarError, match=f"^--algo sac: {finished} is of a training with ppo"):
        resume(finished, algo="sac")
    for text, message in (
        (None, r"config\.yml"),
        ("run: 3\n", "isn't of 'acsar-gym train'"),
        ("run: {options: {robots: many}}\n", r"train\.robots = 'many'"),
    ):
        if text is not None:
            (tmp_path / "config.yml").write_text(text)
        with pytest.raises(AcsarError, match=message):
            resume(tmp_path)

    shutil.copy(finished / "config.yml", tmp_path)
    with pytest.raises(AcsarError, match="has no complete model yet"):
        resume(tmp_path)


def test_resume_starts_a_new_training_at_a_model(finished: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    start = finished / "model.zip"
    train(tiny(out, steps=256, resume=start, trust=True))
    assert folders.count_steps(out / "model.zip") == 256
    for options, message in (
        ({"trust": False}, "pass --trust"),
        ({"env": "path_follow"}, r"model\.zip: observation\[0\] is goal_distance 0 to 2 in the"),
    ):
        settings = {"steps": 256, "resume": start, "trust": True, **options}
        with pytest.raises(AcsarError, match=message) as error:
            train(tiny(tmp_path / next(iter(options)), **settings))
        assert "\n" not in str(error.value)


def test_resume_leaves_the_replay_buffer_of_another_training(tmp_path: Path) -> None:
    """It would be of other robots, and perhaps of another task."""
    start = save(tmp_path / "model.zip", "SAC", buffer_size=10)
    (tmp_path / "replay_buffer.pkl").write_bytes(b"no pickle")
    out = tmp_path / "out"
    train(tiny(out, algo="sac", steps=8, resume=start, trust=True))
    assert folders.count_steps(out / "model.zip") == 8
    with pytest.raises(AcsarError, match="isn't a model of PPO for this env") as error:
        train(tiny(tmp_path / "ppo", steps=8, resume=start, trust=True))
    assert "\n" not in str(error.value)


def test_resume_refuses_models_that_fail_only_when_they_learn(tmp_path: Path) -> None:
    from sb3_contrib import RecurrentPPO

    from acsar_gym.tools.policies import sb3

    sac = save(tmp_path / "sac.zip", "SAC", buffer_size=10)
    lstm = tmp_path / "lstm.zip"
    RecurrentPPO("MlpLstmPolicy", sb3.make_batch("point_goal", 2), n_steps=8).save(lstm)
    for start, algo, message in (
        (sac, "tqc", r"sac\.zip: contains a SACPolicy, which TQC can't train"),
        (lstm, "ppo", r"lstm\.zip: contains a RecurrentActorCriticPolicy, which PPO can't train"),
    ):
        with pytest.raises(AcsarError, match=message):
            train(tiny(tmp_path / algo, algo=algo, steps=8, resume=start, trust=True))


def test_resume_takes_more_steps_and_writes_a_missing_policy(
    finished: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / "copy"
    shutil.copytree(finished, folder)
    (folder / "policy.onnx").unlink()  # as on a full disk
    resume(folder)
    assert (folder / "policy.onnx").exists()
    assert len(curve(folder)) == len(curve(finished))
    assert resume(folder, steps=512, checkpoint_seconds=5.0).score.steps == 512
    options = yaml.safe_load((folder / "config.yml").read_text())["run"]["options"]
    assert (options["steps"], options["checkpoint_seconds"]) == (512, 5.0)  # if it is killed now
    assert "going on at 256 of 512 steps, with new episodes\n" in capsys.readouterr().out
    assert (folder / "learning_curve.png").read_bytes().startswith(b"\x89PNG")


@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
def test_train_leaves_the_last_checkpoint_on_a_full_disk(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write = folders.write_model

    def write_until_full(model: Any, path: Path) -> None:
        with full_disk(1000) if model.num_timesteps == 512 else contextlib.nullcontext():
            write(model, path)

    monkeypatch.setattr(folders, "write_model", write_until_full)
    with pytest.raises(AcsarError) as error:
        train(tiny(tmp_path, steps=768, checkpoint_seconds=0.0))
    message = str(error.value)
    del error
    gc.collect()  # the file that stable-baselines3 leaves open: here, not in a later test
    newest = tmp_path / "checkpoints" / "rl_model_256_steps.zip"
    assert message.startswith(f"--out {tmp_path}: can't be written: File too large: make room")
    assert f"--resume {tmp_path}" in message
    assert "\n" not in message
    assert folders.find_models(tmp_path) == [newest]


def test_train_seeds_gives_every_seed_a_folder_and_a_row(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    scores = train_seeds(tiny(tmp_path, seeds="3,5", steps=1, robots=4))
    with (tmp_path / "seeds.csv").open() as file:
        rows = {int(row["seed"]): float(row["success_rate"]) for row in csv.DictReader(file)}
    assert rows == {seed: score.success_rate for seed, score in scores.items()}
    assert set(rows) == {3, 5}
    assert f"worst {min(rows.values()):.1%}" in capsys.readouterr().out
    for seed in rows:
        assert f"seed {seed}" in (tmp_path / f"seed-{seed}-log.txt").read_text(encoding="utf-8")
        assert (tmp_path / f"seed-{seed}" / "policy.onnx").exists()


def test_train_seeds_refuses_the_folder_of_another_command(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Which has started at the same time. A seed without a model would delete its folder."""
    monkeypatch.setattr(folders, "check_empty", lambda out: None)
    (tmp_path / "seeds.csv").touch()
    with pytest.raises(ConfigError, match=f"--out {tmp_path}: seeds.csv can't be created: File"):
        train_seeds(tiny(tmp_path, seeds="3,5", steps=1, robots=4))


def test_train_seeds_leaves_nothing_if_no_seed_was_started(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="--workers 0: must be"):
        train_seeds(tiny(tmp_path, seeds="3,5", steps=1, robots=4, workers=0))
    assert not list(tmp_path.iterdir())


def test_parse_seeds_reads_ranges_and_lists() -> None:
    assert parse_seeds("1,5,7-9") == [1, 5, 7, 8, 9]
    for text in ("", "3-1", "a", "1,,2", "1-", "0-1000", "4294967296"):
        with pytest.raises(ConfigError, match=r"--seeds .*: must be like"):
            parse_seeds(text)


def test_training_command_contains_no_folder_and_no_address() -> None:
    options: dict[str, Any] = {
        "seeds": "0-3",
        "worlds": ("clutter", "/home/me/hall.world"),
        "robot": "/home/me/my.yaml",
        "randomize": False,
        "net": (64, 64),
        "address": "ray://10.0.0.3",
    }
    settings = TrainingOptions(out=Path("/home/me/run"), **options)
    assert folders.training_command(settings) == (
        "acsar-gym train --seeds 0-3 --worlds clutter --worlds hall.world --robot my.yaml "
        "--no-randomize --net 64 64"
    )
