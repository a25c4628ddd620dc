"""Recipes: RL Zoo's files, read without running code, with errors that name file and key."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest
import yaml
from gymnasium.spaces import Box
from torch.nn import ReLU

from acsar_gym.errors import ConfigError
from acsar_gym.registration import IDS
from acsar_gym.tools.training import recipes
from acsar_gym.tools.training.networks import MirrorPolicy
from acsar_gym.tools.training.recipes import (
    ALGORITHMS,
    BATCH_WRAPPER,
    find_algorithm,
)

pytestmark = pytest.mark.xdist_group(__name__)

GOOD = "default: {n_timesteps: 1e3, n_envs: 4, policy: MlpPolicy, n_steps: 8}\n"


@pytest.mark.parametrize("name", ALGORITHMS)
@pytest.mark.parametrize("env_id", [*IDS, "mine/Task-v0"])
def test_every_algorithm_has_a_recipe_for_every_env(name: str, env_id: str) -> None:
    own = env_id if "/" in env_id else f"acsar_gym/{env_id}"
    recipe = recipes.read_recipe(find_algorithm(name), own)
    entries = yaml.safe_load(recipe.file.read_text())
    assert recipe.key == ("default" if own not in entries else own)
    assert recipe.build_arguments()["policy"] == recipe.policy or "." in recipe.policy
    assert "link" not in recipe.env_kwargs
    wrappers = yaml.safe_load(yaml.safe_dump(recipe.as_dict()))["vec_env_wrapper"]
    assert wrappers == [BATCH_WRAPPER, *({name: {}} for name in recipe.wrappers)]


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("[", "YAML"),
        ("mine/Other-v0: {}", "mine/Task-v0"),
        (GOOD.replace("n_steps", "n_step"), "'n_step'; did you mean 'n_steps'"),
        (GOOD.replace("n_steps: 8", "env_wrapper: a.b"), "env_wrapper: only rl_zoo3"),
        (GOOD.replace("n_steps: 8", "normalize: maybe"), "normalize: 'maybe'"),
        (GOOD.replace("1e3", "many"), "n_timesteps = 'many'"),
        (GOOD.replace("n_timesteps: 1e3, ", ""), "n_timesteps"),
        (GOOD.replace("n_steps: 8", "target_kl: [0.1]"), "target_kl = [0.1]"),
        (GOOD.replace("n_steps: 8", "use_sde: 1"), "use_sde = 1"),
        (GOOD.replace("MlpPolicy", "no.such.Policy"), "policy: 'no.such.Policy'"),
        (
            GOOD.replace("n_steps: 8", "policy_kwargs: {activation_fn: torch.nn.ReLUU}"),
            "activation_fn: torch.nn.ReLUU: can't be imported",
        ),
        (
            "a: &a [1]\nb: &b [*a, *a]\nother: {}",
            "has no 'mine/Task-v0' and no 'default'; known: a, b, other: name one with",
        ),
        ("default: !!python/object/apply:os.abort []", "not valid YAML"),
        ("? [a]\n: 1\n", "a key must be text"),
        (GOOD.replace("n_steps: 8", "vec_env_wrapper: [a.b, a.b]"), "'a.b'"),
    ],
)
def test_a_bad_recipe_is_refused_in_one_line(text: str, said: str, tmp_path: Path) -> None:
    file = tmp_path / "mine.yml"
    file.write_text(text)
    with pytest.raises(ConfigError) as error:
        recipes.read_recipe(find_algorithm("ppo"), "mine/Task-v0", file)
    assert str(error.value).startswith(f"{file}: ")
    assert said in str(error.value)
    assert "\n" not in str(error.value)


EVIL = "import pathlib; pathlib.Path('ran').touch()\n"
HOSTILE: dict[str, dict[str, object]] = {
    "code": {"policy_kwargs": "dict(activation_fn=get_class_by_name('os.abort'))"},
    "function": {"policy_kwargs": {"activation_fn": "os.abort"}},
    "policy": {"policy": "evil.Policy"},
    "worlds": {"env_kwargs": {"worlds": "evil:corr:0-9"}},
    "sensors": {"env_kwargs": {"sensors": ["evil:Sonar"]}},
    "task": {"env_kwargs": {"task": "evil:Task"}},
    "nested": {"env_kwargs": {"faults": {"evil:x": [["evil:y"]]}}},
    "wrapper": {"vec_env_wrapper": "evil.wrap"},
    "monitor": {
        "vec_env_wrapper": {"stable_baselines3.common.vec_env.VecMonitor": {"filename": "ran"}}
    },
    "buffer": {"replay_buffer_class": "evil.Buffer"},
}


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A current folder with a module that a recipe must not import."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [*sys.path, ""])
    (tmp_path / "evil.py").write_text(EVIL)
    return tmp_path


def written(folder: Path, given: dict[str, object]) -> Path:
    file = folder / "mine.yml"
    file.write_text(yaml.safe_dump({"default": {"n_timesteps": 64, "n_envs": 2} | given}))
    return file


@pytest.mark.parametrize("name", HOSTILE)
def test_a_hostile_recipe_runs_and_writes_nothing(name: str, folder: Path) -> None:
    file = written(folder, HOSTILE[name])
    with pytest.raises(ConfigError) as error:
        recipes.read_recipe(find_algorithm("sac"), "mine/Task-v0", file)
    assert str(error.value).startswith(f"{file}: default: ")
    assert "\n" not in str(error.value)
    assert sorted(path.name for path in folder.iterdir()) == ["evil.py", "mine.yml"]
    assert "evil" not in sys.modules


ZOO = """
# as in RL Zoo's own files: many entries, anchors, merge keys, texts of Python
atari:
  env_wrapper: [stable_baselines3.common.atari_wrappers.AtariWrapper]
  n_timesteps: !!float 1e7
Cheetah-v0: &defaults
  normalize: true
  n_envs: 16
  n_timesteps: !!float 2e6
  policy: 'MlpPolicy'
  gamma: 0.98
  learning_rate: !!float 3e-5
  clip_range: 0.4
  policy_kwargs: "dict(log_std_init=-2,
                       ortho_init=False,
                       activation_fn=nn.ReLU,
                       net_arch=[dict(pi=[256, 64], vf=[256])]
                       )"
Walker-v0:
  <<: *defaults
  n_envs: 8
  clip_range: lin_0.4
  normalize: "{'norm_obs': False, 'norm_reward': False}"
Plain-v0:
  n_timesteps: 1000
  normalize: "dict(norm_obs=True, norm_reward=True, clip_reward=5)"
"""


def test_rl_zoo_files_are_read_unchanged(tmp_path: Path) -> None:
    file, ppo = tmp_path / "ppo.yml", find_algorithm("ppo")
    file.write_text(ZOO)
    cheetah = recipes.read_recipe(ppo, "mine/Task-v0", file, entry="Cheetah-v0")
    assert (cheetah.key, cheetah.steps, cheetah.robots) == ("Cheetah-v0", 2_000_000, 16)
    rewards = {"gamma": 0.98, "norm_obs": False}
    assert cheetah.wrappers == {recipes.NORMALIZE_WRAPPER: rewards}
    assert "observations aren't normalized" in cheetah.note
    kwargs = cheetah.build_arguments()["policy_kwargs"]
    assert kwargs["activation_fn"] is ReLU
    assert kwargs["net_arch"] == {"pi": [256, 64], "vf": [256]}
    assert (kwargs["log_std_init"], kwargs["ortho_init"]) == (-2, False)
    walker = recipes.read_recipe(ppo, "Walker-v0", file)
    assert (walker.robots, walker.arguments["gamma"], walker.wrappers) == (8, 0.98, {})
    assert walker.build_arguments()["clip_range"](1.0) == 0.4
    plain = recipes.read_recipe(ppo, "Plain-v0", file)
    assert plain.robots == 1
    clipped = {"gamma": 0.99, "norm_obs": False, "norm_reward": True, "clip_reward": 5}
    assert plain.wrappers == {recipes.NORMALIZE_WRAPPER: clipped}
    kept = tmp_path / "config.yml"  # what a training records of it is a recipe, too
    kept.write_text(yaml.safe_dump({"mine/Task-v0": cheetah.as_dict()}))
    again = recipes.read_recipe(ppo, "mine/Task-v0", kept)
    assert (again.arguments, again.wrappers) == (cheetah.arguments, cheetah.wrappers)


@pytest.mark.parametrize(
    "text",
    [
        "dict(activation_fn=get_class_by_name('os.abort'))",
        "__import__('os').abort()",
        "dict(**{'a': 1})",
        "dict([('a', 1)])",
        "[x for x in (1, 2)]",
        "f'{1}'",
        "(lambda: 1)()",
        "dict(a=nn.ReLU())",
        "dict(a=1",
        "1 if True else 2",
        "9**9**9",
        "((((" * 2000,
    ],
)
def test_texts_of_python_run_nothing(text: str, tmp_path: Path) -> None:
    file = tmp_path / "mine.yml"
    file.write_text(yaml.safe_dump({"default": {"n_timesteps": 8, "policy_kwargs": text}}))
    with pytest.raises(ConfigError) as error:
        recipes.read_recipe(find_algorithm("ppo"), "mine/Task-v0", file)
    assert str(error.value).startswith(f"{file}: default: policy_kwargs: ")
    assert "\n" not in str(error.value)


def test_named_modules_may_be_used(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "my_networks.py").write_text("from torch.nn import ReLU as MyUnit\n")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [*sys.path])
    file = tmp_path / "mine.yml"
    kwargs = {"activation_fn": "my_networks.MyUnit"}
    env = {"worlds": "my_worlds:corr:0-9"}
    given = {"n_timesteps": 8, "n_envs": 1, "policy_kwargs": kwargs, "env_kwargs": env}
    file.write_text(yaml.safe_dump({"default": given}))
    modules = ("my_networks", "my_worlds")
    recipe = recipes.read_recipe(find_algorithm("ppo"), "mine/Task-v0", file, modules)
    assert recipe.build_arguments()["policy_kwargs"]["activation_fn"].__name__ == "ReLU"
    assert recipe.env_kwargs == env
    with pytest.raises(ConfigError, match="a recipe imports nothing: name the module"):
        recipes.read_recipe(find_algorithm("ppo"), "mine/Task-v0", file, modules[:1])


def test_a_mirror_policy_takes_names_as_rl_zoo_gives_them() -> None:
    given = recipes.read_recipe(find_algorithm("ppo"), "acsar_gym/Barn-v1").arguments[
        "policy_kwargs"
    ]
    observed, acted = Box(-1.0, 1.0, (97,)), Box(-1.0, 1.0, (2,))
    policy = MirrorPolicy(observed, acted, lambda _: 0.001, **given)
    assert policy.activation_fn is ReLU
