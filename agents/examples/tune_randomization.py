"""Sweep the randomization of a training and its seeds with Ray Tune.

    pip install "acsar_gym[train,fast,scale]"
    python agents/examples/tune_randomization.py --env obstacle_goal --levels 0 2 3 --seeds 0-4

Level 0 randomizes nothing, 2 is what `acsar-gym train` does, 1 and 3 are half and twice of that.
Every policy is then evaluated under level 3: the table shows which randomization makes policies
robust, and how much its seeds differ. A trial takes one CPU; `--address` runs them on a cluster,
and a trial whose machine dies is started again.
"""

from functools import partial
from pathlib import Path

import tyro

from acsar_gym.tools.jobs import connect_cluster
from acsar_gym.tools.training.seeds import parse_seeds, run_trial


def trial(config: dict[str, int], env: str, steps: int | None, episodes: int) -> dict[str, float]:
    """Train one seed at one level of randomization, and evaluate the policy."""
    return {"success": run_trial(env, config["level"], config["seed"], steps, episodes)}


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
