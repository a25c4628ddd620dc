"""Search the constants of a baseline for a robot, and compare them with the defaults.

    pip install "acsar_gym[train,fast]"
    python agents/tune_baselines.py mppi --env barn --robot jackal --minutes 20

It maximizes the mean score of the benchmark (of Barn the contest's, at the robot's own speed) in
the 64 worlds of the validation split, on link planar: Optuna's TPE proposes, beginning with what
`tuned.json` has and with the defaults, and successive halving drops what is worse than half of the
others after 8, 16 and 32 worlds. Then both drive 100 worlds that belong to no split, and the
defaults stay where what was found is no better there: the best of many trials is also the luckiest.
The result goes into acsar_gym/tools/baselines/tuned.json, with its worlds, seeds and scores, and is
used from then on; `--minutes 0` only compares.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import optuna
import tyro

from acsar_gym.envs.ids import find_id
from acsar_gym.errors import ConfigError
from acsar_gym.tools.baselines import BaselinePolicy, load_baseline
from acsar_gym.tools.baselines.tuning import TUNED, Constants, find_constants, short_id
from acsar_gym.tools.benchmark.figures import COMPLETION_TIME, Scoring, score_episode
from acsar_gym.tools.evaluation import metrics, runs
from acsar_gym.tools.evaluation.episodes import EpisodeResult, run_episodes
from acsar_gym.worlds import registry

FRESH = "5000-5099"
"""Worlds of no split."""
FIRST_RUNG = 8
"""Worlds after which a trial may be dropped for the first time."""
LOGARITHMIC = 8.0
"""Ranges whose ends are at least this factor apart are searched by their logarithm."""


class Course:
    """Worlds that a baseline drives one after the other, with any constants.

    Args:
        policy: the baseline.
        robot: preset or file.
        numbers: of the worlds, such as "900-923", or a split; seeds count from 0.
        steps: after which an episode ends; by default those of the id.
    """

    def __init__(
        self, policy: BaselinePolicy, robot: str, numbers: str, steps: int | None = None
    ) -> None:
        own: Any = runs.make_env(policy, "planar", robot, {}).unwrapped
        if own.pool is None:
            raise ConfigError(f"{policy.env_id}: has no worlds to search in: take another --env")
        self.policy, self.worlds = policy, f"{own.pool.kind}:{numbers}"
        options = {"worlds": self.worlds, "max_episode_steps": steps}
        self.env = runs.make_env(policy, "planar", robot, options)
        inner: Any = self.env.unwrapped
        self.inner, self.config = inner, inner.robot.config

    def __len__(self) -> int:
        return len(self.inner.pool.numbers)

    def drive(self, constants: Constants, place: int) -> tuple[float, bool]:
        """Drive in one world; returns its score and whether the goal was reached."""
        self.policy.use_constants(constants)
        self.policy.equip(self.policy.setting)
        (result,) = run_episodes(self.env, self.policy, 1, seed=place, in_order=True, skip=place)
        return self.score(result), result.success

    def score(self, result: EpisodeResult) -> float:
        """The contest's score at the robot's own speed where there is one, else the benchmark's."""
        if result.scores:
            return result.scores[2]
        speed, tolerance = self.config.max_linear, self.inner.task.goal_tolerance
        return score_episode(result, Scoring(COMPLETION_TIME, speed, tolerance))

    def compare(self, constants: Constants) -> dict[str, Any]:
        """Drive in all worlds; returns success and mean score with their 95 % intervals."""
        driven = [self.drive(constants, place) for place in range(len(self))]
        scores = np.array([score for score, _ in driven])
        wins = sum(success for _, success in driven)
        low, high = metrics.stratified_interval(scores[None, :], metrics.row_means)
        success = metrics.wilson_interval(wins, len(driven))
        return {
            "success": wins / len(driven),
            "success_interval": [round(end, 3) for end in success],
            "score": round(float(scores.mean()), 4),
            "score_interval": [round(low, 4), round(high, 4)],
        }


def search(course: Course, minutes: float, first: list[Constants]) -> Any:
    """Search constants.

    Args:
        course: the worlds.
        minutes: after which no trial begins.
        first: constants to begin with.

    Returns:
        The study.
    """
    kind: Any = course.policy.constants_type
    ranges: dict[str, tuple[float, float]] = kind.ranges()

    def drive_all(trial: optuna.Trial) -> float:
        chosen = kind(
            **{
                name: round_figures(
                    trial.suggest_float(name, low, high, log=high >= LOGARITHMIC * low)
                )
                for name, (low, high) in ranges.items()
            }
        )
        scores: list[float] = []
        for place in range(len(course)):
            scores.append(course.drive(chosen, place)[0])
            trial.report(float(np.mean(scores)), len(scores))
            if trial.should_prune():
                raise optuna.TrialPruned
        return float(np.mean(scores))

    study = optuna.create_study(
        direction="maximize",
        sampler=optuna.samplers.TPESampler(seed=0, multivariate=True, n_startup_trials=8),
        pruner=optuna.pruners.SuccessiveHalvingPruner(FIRST_RUNG, 2),
    )

    def tell(study: optuna.Study, trial: optuna.trial.FrozenTrial) -> None:
        last = trial.last_step or 0
        value = trial.intermediate_values.get(last, 0.0)
        print(f"trial {trial.number}: {value:.4f} in {last} worlds", flush=True)

    for constants in first:
        study.enqueue_trial({name: getattr(constants, name) for name in ranges})
    study.optimize(drive_all, timeout=60.0 * minutes, callbacks=[tell])
    return study


def round_figures(value: float) -> float:
    """Round to three significant figures, as many as `tuned.json` has."""
    return float(f"{value:.3g}")


def write_entry(entry: dict[str, Any], file: Path) -> None:
    """Write the entry of a planner, id and robot in place of its last one."""
    key = ("planner", "id", "robot")
    every = {tuple(each[k] for k in key): each for each in json.loads(file.read_text())}
    every[tuple(entry[k] for k in key)] = entry
    entries = [every[name] for name in sorted(every)]
    file.write_text(json.dumps(entries, indent=1) + "\n", encoding="utf-8")


def main(
    planner: str,
    /,
    env: str = "barn",
    robot: str = "jackal",
    minutes: float = 20.0,
    steps: int | None = None,
    worlds: str = registry.VALIDATION,
    fresh: str = FRESH,
    file: Path = TUNED,
) -> None:
    """Search, compare with the defaults, and keep what was found.

    Args:
        planner: name of the baseline.
        env: short name or id of the env.
        robot: preset.
        minutes: after which no trial begins; 0 to compare only.
        steps: after which an episode of the search ends, which saves time where planners get stuck.
        worlds: numbers or split of the worlds of the search.
        fresh: numbers of the worlds of the comparison; "" for none.
        file: that the result is written to.
    """
    policy = load_baseline(planner, find_id(env))
    kind: Any = policy.constants_type
    course = Course(policy, robot, worlds, steps)
    known = find_constants(kind, planner, policy.env_id, course.config)
    entry: dict[str, Any] = {"planner": planner, "id": short_id(policy.env_id), "robot": robot}
    for each in json.loads(file.read_text()):
        entry |= each if all(each[key] == value for key, value in entry.items()) else {}
    entry.setdefault("constants", {})
    if minutes > 0.0:
        optuna.logging.set_verbosity(optuna.logging.WARNING)
        study = search(course, minutes, list(dict.fromkeys([known, kind()])))
        entry["constants"] = {
            name: round_figures(value)
            for name, value in study.best_params.items()
            if value != getattr(kind(), name)
        }
        entry["search"] = {
            "worlds": course.worlds,
            "seeds": f"0-{len(course) - 1}",
            "steps": steps,
            "trials": len(study.trials),
            "score": round(study.best_value, 4),
        }
        print(f"{planner} {entry['id']} {robot}: {entry['constants']}\n  {entry['search']}")
        write_entry(entry, file)
    if fresh:
        course.env.close()
        course = Course(policy, robot, fresh)
        defaults, tuned = course.compare(kind()), course.compare(kind(**entry["constants"]))
        entry["comparison"] = {
            "worlds": course.worlds,
            "seeds": f"0-{len(course) - 1}",
            "defaults": defaults,
            "tuned": tuned,
        }
        if tuned["score"] <= defaults["score"]:
            entry["constants"] = {}
        print(f"  {json.dumps(entry['comparison'])}")
        write_entry(entry, file)
    course.env.close()


if __name__ == "__main__":
    tyro.cli(main)
