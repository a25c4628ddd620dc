"""Sweep the randomization of a training and its seeds with Ray Tune.

    pip install "acsar_gym[train,fast,scale]"
    python agents/examples/tune_randomization.py --env obstacle_goal --levels 0 2 3 --seeds 0-4

Level 0 randomizes nothing, 2 is what `acsar-gym train` does, 1 and 3 are half and twice of that.
Every policy is then evaluated under level 3: the table shows which randomization makes policies
robust, and how much its seeds differ. A trial takes one CPU; `--address` runs them on a cluster,
and a trial whose machine dies is started again.
"""

import argparse
import statistics
import tempfile
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any

import yaml

from acsar_gym.config import RobotConfig
from acsar_gym.dynamics.levels import level
from acsar_gym.envs import ids
from acsar_gym.evaluation import episodes, metrics, runs
from acsar_gym.scaling.cluster import connected
from acsar_gym.training import recipes, run, seeds
from acsar_gym.training.algorithms import algorithm
from acsar_gym.training.options import Options

HARDEST = 3
RETRIES = 3


def recipe(env: str, number: int) -> dict[str, Any]:
    """The env's recipe for PPO with the randomization of a level."""
    env_id = ids.without_module(ids.registered(env))
    found = recipes.recipe(algorithm("ppo"), env_id).as_dict()
    if number:
        ranges = asdict(level(RobotConfig.of(None), number))
        known = {name: list(each) for name, each in ranges.items() if each is not None}
        found["env_kwargs"] = {**found["env_kwargs"], "randomization": known}
    return {env_id: found}


def robust(policy: Path, count: int) -> float:
    """The success rate of a policy where the robots differ most."""
    loaded = runs.load(str(policy), trust=False)
    env = runs.made(loaded, "planar", None, {"randomization": level(RobotConfig.of(None), HARDEST)})
    results = list(episodes.episodes(env, loaded, count, seed=0))
    env.close()
    return metrics.summarise(results).success_rate


def trial(config: dict[str, int], env: str, steps: int | None, count: int) -> dict[str, float]:
    """Train one seed at one level of randomization, and evaluate the policy."""
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder)
        file = out / "recipe.yml"
        file.write_text(yaml.safe_dump(recipe(env, config["level"])), encoding="utf-8")
        options = Options(
            env=env,
            seed=config["seed"],
            steps=steps,
            conf_file=file,
            randomize=config["level"] > 0,
            out=out,
            threads=1,
            progress=False,
        )
        run.train(options)
        return {"success": robust(out / "policy.onnx", count)}


def table(results: Any) -> None:
    """Print the median and the worst seed of every level."""
    rates: dict[int, list[float]] = {}
    for result in results:
        if result.error is None:
            rates.setdefault(result.config["level"], []).append(result.metrics["success"])
    print(f"success under randomization of level {HARDEST}")
    print("trained at level   seeds   median   worst")
    for number, found in sorted(rates.items()):
        median, worst = statistics.median(found), min(found)
        print(f"{number:16} {len(found):7} {median:8.1%} {worst:7.1%}")


def main(arguments: list[str] | None = None) -> None:
    """Run the sweep and print its table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--env", default="obstacle_goal")
    parser.add_argument("--levels", type=int, nargs="+", default=[0, 2, 3], choices=range(4))
    parser.add_argument("--seeds", default="0-4")
    parser.add_argument("--steps", type=int, help="of each training; default: the recipe's")
    parser.add_argument("--episodes", type=int, default=200, help="to evaluate each policy")
    parser.add_argument("--address", default="local", help="of a Ray cluster")
    parser.add_argument("--out", type=Path, default=Path("runs/tune"))
    asked = parser.parse_args(arguments)
    with connected(asked.address):
        from ray import tune  # noqa: PLC0415 - `connected` keeps Ray from sending statistics

        tuner = tune.Tuner(
            partial(trial, env=asked.env, steps=asked.steps, count=asked.episodes),
            param_space={
                "level": tune.grid_search(asked.levels),
                "seed": tune.grid_search(seeds.parsed(asked.seeds)),
            },
            tune_config=tune.TuneConfig(metric="success", mode="max"),
            run_config=tune.RunConfig(
                storage_path=str(asked.out.resolve()),
                failure_config=tune.FailureConfig(max_failures=RETRIES),
                verbose=0,
            ),
        )
        table(tuner.fit())


if __name__ == "__main__":
    main()
