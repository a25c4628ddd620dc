"""Trainings of several seeds, and trials of a sweep over levels of randomization."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import pytest

from acsar_gym.errors import ConfigError
from acsar_gym.physics import Randomization
from acsar_gym.resources import AGENTS
from acsar_gym.tools.training import seeds
from acsar_gym.tools.training.plan import TrainingOptions, TrainingPlan
from acsar_gym.worlds import Region, World, files

pytestmark = pytest.mark.xdist_group(__name__)

SMALL = ("--steps", "1", "--robots", "4")


def test_every_seed_has_a_folder_and_a_row(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert seeds.main(["--seeds", "3,5", *SMALL, "--out", str(tmp_path)]) == 0
    said = capsys.readouterr().out
    data = json.loads((tmp_path / "seeds.json").read_text(encoding="utf-8"))
    rates = [each["success_rate"] for each in data["seeds"]]
    assert [each["seed"] for each in data["seeds"]] == [3, 5]
    assert data["worst"] == min(rates)
    assert data["median"] == sum(rates) / 2
    assert f"worst {min(rates):.1%}" in said
    for seed in (3, 5):
        folder = tmp_path / f"seed-{seed}"
        assert f"seed {seed}" in (folder / "log.txt").read_text(encoding="utf-8")
        assert (folder / "policy.onnx").exists()
        assert (folder / "model.zip").exists()


@pytest.mark.slow
def test_files_of_a_training_go_to_another_machine_and_come_back(tmp_path: Path) -> None:
    """A job that runs away writes nothing here; its files arrive with its result."""
    recipe = tmp_path / "mine.yml"
    recipe.write_bytes((AGENTS / "recipes" / "ppo.yml").read_bytes())
    options = TrainingOptions(steps=1, robots=4, conf_file=recipe, seeds="2", address="nowhere:1")
    job = seeds.make_job(options, 2, tmp_path / "out")
    recipe.unlink()
    trained = seeds.run_job(job)
    assert not (tmp_path / "out").exists()
    seeds.keep_files(trained, tmp_path / "out")
    names = {path.name for path in (tmp_path / "out" / "seed-2").iterdir()}
    assert {"policy.onnx", "model.zip", "config.yml", "log.txt"} <= names
    assert "checkpoints" not in names


def test_worlds_of_files_go_to_another_machine(tmp_path: Path) -> None:
    """A generator's name goes as it is, a file by its content, and a folder not at all."""
    hall = World(goal=Region(3.0, 0.0), name="hall")
    for name in ("hall", "room"):
        files.save_world(hall, tmp_path / f"{name}.yaml")
    options = TrainingOptions(seeds="2", address="nowhere:1")
    mixed = options.model_copy(update={"worlds": ("open:3", str(tmp_path / "hall.yaml"))})
    job = seeds.make_job(mixed, 2, tmp_path / "out")
    assert job.options.worlds == ("open:3", "hall.json")
    assert job.sent == (("worlds", "hall.json", files.format_world(hall, ".json")),)
    with pytest.raises(ConfigError, match="a folder can't be sent"):
        seeds.make_job(options.model_copy(update={"worlds": (str(tmp_path),)}), 2, tmp_path)


def test_a_recipe_may_have_ranges_of_its_own(tmp_path: Path) -> None:
    recipe = tmp_path / "mine.yml"
    text = "{env_kwargs: {randomization: {friction: [0.7, 1.2]}}, n_timesteps: 1, n_envs: 4}"
    recipe.write_text(f"acsar_gym/PointGoal-v0: {text}", encoding="utf-8")
    plan = TrainingPlan.of(TrainingOptions(conf_file=recipe, out=tmp_path, robots=4, threads=1))
    assert plan.randomization == Randomization(friction=(0.7, 1.2))
    plan.make_held_out_batch(plan.make_training_batch()).close()
    plain = replace(plan, options=plan.options.model_copy(update={"randomize": False}))
    assert plain.randomization == Randomization()


def test_a_trial_trains_and_gives_a_success_rate() -> None:
    assert 0.0 <= seeds.run_trial("point_goal", 3, seed=1, steps=1, count=2) <= 1.0


def test_a_recipe_has_the_ranges_of_its_level() -> None:
    friction = []
    for level in (1, 2, 3):
        (recipe,) = seeds.randomized_recipe("point_goal", level).values()
        low, high = recipe["env_kwargs"]["randomization"]["friction"]
        friction.append(high - low)
    assert friction == sorted(friction)
    with pytest.raises(ConfigError, match="must be 1, 2 or 3"):
        seeds.randomized_recipe("point_goal", 4)
