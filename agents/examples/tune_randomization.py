"""Sweep the randomization of a training and its seeds with Ray Tune.

    pip install "acsar_gym[train,fast,scale]"
    python agents/examples/tune_randomization.py --env obstacle_goal --levels 0 2 3 --seeds 0-4

Level 0 randomizes nothing, 2 is what `acsar-gym train` does, 1 and 3 are half and twice of that.
Every policy is then evaluated under level 3: the table shows which randomization makes policies
robust, and how much its seeds differ. A trial takes one CPU; `--address` runs them on a cluster,
and a trial whose machine dies is started again.
"""

import tempfile
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any

import tyro

from acsar_gym import RobotConfig, reading
from acsar_gym.envs import ids
from acsar_gym.physics.randomization import LEVEL_WIDTHS, randomization_level
from acsar_gym.tools.evaluation import runs
from acsar_gym.tools.evaluation.episodes import run_episodes
from acsar_gym.tools.evaluation.metrics import summarise_episodes
from acsar_gym.tools.jobs.cluster import connect_cluster
from acsar_gym.tools.training import recipes
from acsar_gym.tools.training.plan import TrainingOptions
from acsar_gym.tools.training.run import train
from acsar_gym.tools.training.seeds import parse_seeds


def randomized_recipe(env: str, level: int) -> dict[str, Any]:
    """The env's recipe for PPO with the randomization of a level, as a recipe file has it."""
    env_id = ids.strip_module(ids.find_id(env))
    found = recipes.read_recipe(recipes.find_algorithm("ppo"), env_id).as_dict()
    if level:
        ranges = asdict(randomization_level(RobotConfig.of(None), level))
        known = {name: list(each) for name, each in ranges.items() if each is not None}
        found["env_kwargs"] = {**found["env_kwargs"], "randomization": known}
    return {env_id: found}


def trial(config: dict[str, int], env: str, steps: int | None, episodes: int) -> dict[str, float]:
    """Train one seed at one level of randomization, and evaluate the policy at the hardest."""
    level = config["level"]
    with tempfile.TemporaryDirectory() as folder:
        out, recipe = Path(folder), Path(folder, "recipe.yml")
        recipe.write_text(reading.format_yaml(randomized_recipe(env, level)), encoding="utf-8")
        asked: dict[str, Any] = {"steps": steps, "conf_file": recipe, "randomize": level > 0}
        asked |= {"seed": config["seed"], "out": out, "threads": 1, "progress": False}
        train(TrainingOptions(env=env, **asked))
        policy = runs.load_policy(str(out / "policy.onnx"), trust=False)
    hardest = randomization_level(RobotConfig.of(None), max(LEVEL_WIDTHS))
    harder = runs.make_env(policy, "planar", None, {"randomization": hardest})
    results = list(run_episodes(harder, policy, episodes, 0))
    harder.close()
    return {"success": summarise_episodes(results).success_rate}


def main(
    env: str = "obstacle_goal",
    levels: tuple[int, ...] = (0, 2, 3),
    seeds: str = "0-4",
    steps: int | None = None,
    episodes: int = 200,
    address: str = "local",
    out: Path = Path("runs/tune"),
) -> None:
    """Run the sweep and print its table; `steps` of each training are the recipe's by default."""
    with connect_cluster(address):
        from ray import tune  # noqa: PLC0415 - `connect_cluster` keeps Ray from sending statistics

        grid = {"level": list(levels), "seed": parse_seeds(seeds)}
        tuner = tune.Tuner(
            partial(trial, env=env, steps=steps, episodes=episodes),
            param_space={name: tune.grid_search(values) for name, values in grid.items()},
            tune_config=tune.TuneConfig(metric="success", mode="max"),
            run_config=tune.RunConfig(
                storage_path=str(out.resolve()),
                failure_config=tune.FailureConfig(max_failures=3),
                verbose=0,
            ),
        )
        table = tuner.fit().get_dataframe().groupby("config/level").success
    print(table.agg(["count", "median", "min"]).to_string(float_format="{:.1%}".format))


if __name__ == "__main__":
    tyro.cli(main)
