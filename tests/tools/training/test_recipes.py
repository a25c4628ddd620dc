"""Recipes: plain values, read without running code, with errors that name file and key."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import pytest
import yaml

from acsar_gym.errors import ConfigError
from acsar_gym.registration import IDS
from acsar_gym.tools.training import recipes
from acsar_gym.tools.training.options import ALGORITHMS

pytestmark = pytest.mark.xdist_group(__name__)

GOOD = "default: {n_timesteps: 1e3, n_envs: 4, policy: MlpPolicy, n_steps: 8}\n"


@pytest.mark.parametrize("name", ALGORITHMS)
def test_read_recipe_has_recipes_for_every_env_and_reads_config_files(
    name: str, tmp_path: Path
) -> None:
    config = tmp_path / "config.yml"
    for env_id in ("mine/Task-v0", *(f"acsar_gym/{bare_id}" for bare_id in IDS)):
        recipe = recipes.read_recipe(name, env_id)
        assert recipe.build_arguments()["policy"]
        assert "link" not in recipe.env_kwargs
        config.write_text(yaml.safe_dump({env_id: recipe.values, "run": {}}))
        assert recipes.read_recipe(name, env_id, config).values == recipe.values


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("mine/Other-v0: {}", "has no 'mine/Task-v0' and no 'default'"),
        (GOOD.replace("n_steps", "n_step"), "unexpected keyword argument 'n_step'"),
        (GOOD.replace("1e3", "0"), "n_timesteps: must be at least 1"),
        (GOOD.replace("1e3", "many"), "n_timesteps: could not convert string to float: 'many'"),
        (GOOD.replace("n_steps: 8", "gamma: high"), "gamma = 'high': must be a valid number"),
        (GOOD.replace("n_steps: 8", "use_sde: 1"), "use_sde = 1: must be"),
        (GOOD.replace("n_steps: 8", "env_kwargs: [1]"), "env_kwargs = [1]: must be"),
        (GOOD.replace("n_steps: 8", "learning_rate: lin_x"), "convert string to float: 'x'"),
        (
            GOOD.replace("n_steps: 8", "policy_kwargs: {activation_fn: torch.nn.ReLUU}"),
            "activation_fn: torch.nn.ReLUU: can't be imported",
        ),
        (GOOD.replace("n_steps: 8", "env_kwargs: {robot: husky}"), "env_kwargs: robot: leave it"),
        (GOOD.replace("n_steps: 8", "seed: 7"), "seed: leave it out: train's options set it"),
        ("default: !!python/object/apply:os.abort []", "not valid YAML"),
    ],
)
def test_read_recipe_refuses_in_one_line(text: str, message: str, tmp_path: Path) -> None:
    file = tmp_path / "mine.yml"
    file.write_text(text)
    with pytest.raises(ConfigError) as error:
        recipes.read_recipe("ppo", "mine/Task-v0", file)
    assert str(error.value).startswith(f"{file}: ")
    assert message in str(error.value)
    assert "\n" not in str(error.value)


HOSTILE: dict[str, dict[str, Any]] = {
    "function": {"policy_kwargs": {"activation_fn": "os.abort"}},
    "policy": {"policy": "evil.Policy"},
    "worlds": {"env_kwargs": {"worlds": "evil:corr:0-9"}},
    "nested": {"env_kwargs": {"faults": {"evil:x": [["evil:y"]]}}},
    "wrapper": {"vec_env_wrapper": "evil.wrap"},
}


@pytest.mark.parametrize("name", HOSTILE)
def test_read_recipe_imports_nothing_that_a_stranger_names(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [*sys.path, ""])
    (tmp_path / "evil.py").write_text("import pathlib; pathlib.Path('ran').touch()\n")
    file = tmp_path / "mine.yml"
    file.write_text(yaml.safe_dump({"default": {"n_timesteps": 64, "n_envs": 2} | HOSTILE[name]}))
    with pytest.raises(ConfigError) as error:
        recipes.read_recipe("sac", "mine/Task-v0", file)
    assert str(error.value).startswith(f"{file}: default: ")
    assert "\n" not in str(error.value)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["evil.py", "mine.yml"]
    assert "evil" not in sys.modules


@pytest.fixture
def user_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The current folder, whose modules can be imported in this test only."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [*sys.path])
    return tmp_path


def test_import_wrappers_gives_them_their_arguments(user_folder: Path) -> None:
    (user_folder / "my_wrappers.py").write_text("def scale(env, factor): return env * factor\n")
    file = user_folder / "mine.yml"
    wrappers = [recipes.BATCH_WRAPPER, {"my_wrappers.scale": {"factor": 3}}]
    file.write_text(yaml.safe_dump({"default": {"n_timesteps": 8, "vec_env_wrapper": wrappers}}))
    recipe = recipes.read_recipe("ppo", "mine/Task-v0", file, "my_wrappers")
    (scale,) = recipe.import_wrappers()
    assert scale(2) == 6


def test_build_arguments_takes_a_list_for_a_tuple(tmp_path: Path) -> None:
    file = tmp_path / "mine.yml"
    file.write_text("default: {n_timesteps: 8, train_freq: [2, episode]}\n")
    arguments = recipes.read_recipe("sac", "mine/Task-v0", file).build_arguments()
    assert arguments["train_freq"] == (2, "episode")


def test_build_arguments_makes_schedules_and_imports_from_the_package_of_the_env(
    user_folder: Path,
) -> None:
    (user_folder / "my_networks.py").write_text("from torch.nn import ReLU as MyUnit\n")
    file = user_folder / "mine.yml"
    values: dict[str, Any] = {
        "n_timesteps": 8,
        "learning_rate": "lin_0.004",
        "policy_kwargs": {"activation_fn": "my_networks.MyUnit"},
        "env_kwargs": {"worlds": "my_networks.worlds:corr:0-9"},
    }
    file.write_text(yaml.safe_dump({"default": values}))

    recipe = recipes.read_recipe("ppo", "mine/Task-v0", file, "my_networks.tasks")
    arguments = recipe.build_arguments()
    assert arguments["policy_kwargs"]["activation_fn"].__name__ == "ReLU"
    rate = arguments["learning_rate"]
    assert [rate(1.0), rate(0.5)] == pytest.approx([0.004, 0.002])
    assert recipe.env_kwargs == values["env_kwargs"]
    with pytest.raises(ConfigError, match="imports nothing but the package of --env"):
        recipes.read_recipe("ppo", "mine/Task-v0", file, "other")
