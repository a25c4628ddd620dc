"""Recipes: RL Zoo's files, read without running code, with errors that name file and key."""

from __future__ import annotations

from pathlib import Path

import pytest
import yaml

from acsar_gym.errors import ConfigError
from acsar_gym.registration import IDS
from acsar_gym.resources import AGENTS
from acsar_gym.training import expressions, recipes
from acsar_gym.training.algorithms import ALGORITHMS, algorithm

pytestmark = pytest.mark.xdist_group("torch")

GOOD = "default: {n_timesteps: 1e3, n_envs: 4, policy: MlpPolicy, n_steps: 8}\n"


@pytest.mark.parametrize("name", ALGORITHMS)
@pytest.mark.parametrize("env_id", [*IDS, "mine/Task-v0"])
def test_every_algorithm_has_a_recipe_for_every_env(name: str, env_id: str) -> None:
    own = env_id if "/" in env_id else f"acsar_gym/{env_id}"
    recipe = recipes.recipe(algorithm(name), own)
    assert recipe.key == ("default" if own not in recipes.content(recipe.file) else own)
    assert recipe.built()["policy"] == recipe.policy or "." in recipe.policy
    assert "link" not in recipe.env_kwargs
    wrappers = yaml.safe_load(yaml.safe_dump(recipe.as_dict()))["vec_env_wrapper"]
    assert wrappers == [recipes.BATCH, *({name: {}} for name in recipe.wrappers)]


def test_the_files_have_no_ids_that_are_not_registered() -> None:
    for file in (AGENTS / "recipes").glob("*.yml"):
        assert set(recipes.content(file)) <= {"default", *(f"acsar_gym/{own}" for own in IDS)}


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("[", "not YAML"),
        ("- 1", "must be hyperparameters by env id"),
        ("mine/Other-v0: {}", "no recipe for mine/Task-v0, and no 'default'"),
        ("mine/Task-v0: 3", "mine/Task-v0: must be hyperparameters by name"),
        (GOOD.replace("n_steps", "n_step"), "default: 'n_step': not a hyperparameter of ppo; did"),
        (GOOD.replace("n_steps: 8", "normalize: true"), "normalize: only rl_zoo3 knows it"),
        (GOOD.replace("1e3", "many"), "n_timesteps: 'many': must be a number"),
        (GOOD.replace("n_envs: 4, ", ""), "n_envs: None: must be a number"),
        (
            GOOD.replace("n_steps: 8", "target_kl: [0.1]"),
            "target_kl: [0.1]: must be a number or null",
        ),
        (GOOD.replace("n_steps: 8", "gamma: high"), "gamma: 'high': must be a number"),
        (GOOD.replace("n_steps: 8", "n_epochs: 2.5"), "n_epochs: 2.5: must be a whole number"),
        (GOOD.replace("n_steps: 8", "use_sde: 1"), "use_sde: 1: must be true or false"),
        (GOOD.replace("n_steps: 8", "env_kwargs: 3"), "env_kwargs: 3: must be arguments by name"),
        (GOOD.replace("n_steps: 8", "vec_env_wrapper: [[a.b]]"), "['a.b']: must be module.name"),
        (GOOD.replace("n_steps: 8", "vec_env_wrapper: [a.b, a.b]"), "'a.b': must be module.name"),
    ],
)
def test_a_bad_recipe_is_refused_in_one_line(text: str, said: str, tmp_path: Path) -> None:
    file = tmp_path / "mine.yml"
    file.write_text(text)
    with pytest.raises(ConfigError) as error:
        recipes.recipe(algorithm("ppo"), "mine/Task-v0", file)
    assert str(error.value).startswith(f"{file}: ")
    assert said in str(error.value)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("key", "value", "said"),
    [
        ("learning_rate", "linear", "must be a number, or like lin_0.001"),
        ("policy_kwargs", "__import__('os').system('true')", "must be like dict("),
        ("policy_kwargs", "dict(open('x'))", "must be like dict("),
        ("policy_kwargs", "dict(activation_fn=nn.Nothing)", "Nothing"),
        ("policy", "no.such.Policy", "No module named 'no'"),
    ],
)
def test_a_bad_value_is_named_with_its_key(key: str, value: str, said: str, tmp_path: Path) -> None:
    file = tmp_path / "mine.yml"
    file.write_text(yaml.safe_dump({"default": {"n_timesteps": 8, "n_envs": 1, key: value}}))
    recipe = recipes.recipe(algorithm("ppo"), "mine/Task-v0", file)
    with pytest.raises(ConfigError, match=f"default: {key}: ") as error:
        recipe.built()
    assert said in str(error.value)


def test_expressions_of_rl_zoo_are_understood() -> None:
    from torch import nn

    text = (
        "dict(net_arch=dict(pi=[64], vf=[64, 64]), log_std_init=-2, activation_fn=nn.ELU, "
        "kind=get_class_by_name('acsar_gym.training.recipes.Recipe'), small={'a': (1, True)})"
    )
    assert expressions.arguments(text) == {
        "net_arch": {"pi": [64], "vf": [64, 64]},
        "log_std_init": -2,
        "activation_fn": nn.ELU,
        "kind": recipes.Recipe,
        "small": {"a": (1, True)},
    }
    falling = expressions.schedule("lin_0.5")
    assert (falling(1.0), falling(0.5), falling(0.0)) == (0.5, 0.25, 0.0)


@pytest.mark.parametrize("given", [{"log_std_init": 1.0}, "dict(log_std_init=1.0)"])
def test_options_change_a_recipe(given: object, tmp_path: Path) -> None:
    file = tmp_path / "mine.yml"
    content = {"n_timesteps": 8, "n_envs": 1, "policy_kwargs": given, "gamma": 0.9}
    file.write_text(yaml.safe_dump({"default": content}))
    recipe = recipes.recipe(algorithm("ppo"), "mine/Task-v0", file)
    changed = recipe.with_(steps=None, robots=7, gamma=0.5, net=(8, 4))
    assert (changed.steps, changed.robots) == (8, 7)
    built = changed.built()
    assert built["gamma"] == 0.5
    assert built["policy_kwargs"] == {"log_std_init": 1.0, "net_arch": [8, 4]}


def test_an_unknown_algorithm_is_told_those_that_there_are() -> None:
    with pytest.raises(ConfigError, match="--algo pppo: unknown; did you mean 'ppo'"):
        algorithm("pppo")
