"""Sweep the randomization of a training and its seeds with Ray Tune.

    pip install ".[train,fast,scale]"
    python agents/examples/tune_randomization.py --env obstacle_goal --levels 0 2 3 --seeds 0-4

Level 0 randomizes nothing, 2 is what `acsar-gym train` does, 1 and 3 are half and twice of that.
Every policy is then evaluated under level 3: the table shows which randomization makes policies
robust, and how much its seeds differ. A trial takes one CPU; `--address` runs them on a cluster,
and a trial whose machine dies is started again.
"""

import tempfile
from functools import partial
from pathlib import Path

import tyro
import yaml

from acsar_gym import RobotConfig
from acsar_gym.envs import ids
from acsar_gym.physics.randomization import randomization_level
from acsar_gym.tools.evaluation import runs
from acsar_gym.tools.jobs import connect_cluster
from acsar_gym.tools.training.options import TrainingOptions
from acsar_gym.tools.training.recipes import read_recipe
from acsar_gym.tools.training.run import train
from acsar_gym.tools.training.seeds import parse_seeds

LEVELS = {level: randomization_level(RobotConfig(), level).model_dump() for level in (1, 2, 3)}


def trial(config: dict[str, int], env: str, steps: int | None, episodes: int) -> dict[str, float]:
    """Train one seed at one level of randomization, and evaluate the policy at the hardest."""
    env_id = ids.strip_module(ids.find_id(env))
    recipe = read_recipe("ppo", env_id).values
    ranges = {k: list(v) for k, v in LEVELS.get(config["level"], {}).items() if v is not None}
    recipe["env_kwargs"] = {**recipe["env_kwargs"], "randomization": ranges}
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder, "recipe.yml")
        file.write_text(yaml.safe_dump({env_id: recipe}))
        some = {"conf_file": file, "steps": steps, "seed": config["seed"], "progress": False}
        out = train(TrainingOptions(env=env, threads=1, out=Path(folder, "out"), **some)).out
        policy = runs.load_policy(str(out / "policy.onnx"), trust=False)
    results = runs.evaluate_policy(policy, "planar", None, range(episodes), randomization=LEVELS[3])
    return {"success": results.summary.success_rate}


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
