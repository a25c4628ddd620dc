"""Record episodes of a policy as a Minari data set, for offline learning and imitation.

    pip install ".[export,deploy]" "minari[create]"
    python agents/examples/minari_record.py --env acsar_gym:acsar_gym/PointGoal-v0 --steps 2000

Minari's `DataCollector` wraps the environment as it is. The data set, named acsar/PointGoal-v0,
lies in ~/.minari/datasets, or where MINARI_DATASETS_PATH says. To make one from recorded drives, of
a real robot too: `acsar-gym record export drive.mcap --to minari`. 1,500 steps/s on
one core.
"""

import argparse
import time

import gymnasium
import minari

from acsar_gym.tools.evaluation import runs


def main(arguments: list[str] | None = None) -> None:
    """Drive whole episodes until there are `--steps` steps, and write the data set."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--env", default="acsar_gym:acsar_gym/PointGoal-v0")
    parser.add_argument("--steps", type=int, default=2000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--policy", default="point_goal", help="as acsar-gym evaluate takes it")
    parser.add_argument("--name", default="acsar/point_goal-v0", help="of the data set")
    asked = parser.parse_args(arguments)

    policy = runs.load_policy(asked.policy, trust=False, env=asked.env.rpartition(":")[2])
    env = minari.DataCollector(gymnasium.make(asked.env, link="planar"), data_format="arrow")
    started, steps, episode = time.perf_counter(), 0, 0
    while steps < asked.steps:
        observation, _ = env.reset(seed=asked.seed + episode)
        over = False
        while not over:
            observation, _, terminated, truncated, _ = env.step(policy(observation))
            steps, over = steps + 1, terminated or truncated
        episode += 1
    print(f"{steps / (time.perf_counter() - started):,.0f} steps/s")
    data = env.create_dataset(asked.name, algorithm_name=asked.policy)
    print(f"{data.id}: {data.total_episodes} episodes, {data.total_steps} steps")
    env.close()


if __name__ == "__main__":
    main()
