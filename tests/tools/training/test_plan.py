"""How many threads a training takes, and how many updates it has."""

from __future__ import annotations

from typing import Any

import pytest

from acsar_gym.tools.training import plan
from acsar_gym.tools.training.plan import TrainingOptions, TrainingPlan
from acsar_gym.vector.threads import usable_cores


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (
            {"steps": 100_000, "robots": 512, "env": "obstacle_goal"},
            "100,000 steps of 512 robots are 7 updates; --robots 52 there are 61",
        ),
        ({"steps": 100_000, "robots": 16, "env": "obstacle_goal"}, ""),
        ({}, ""),
        ({"steps": 1, "robots": 4}, ""),
        (
            {"steps": 4096, "robots": 512, "algo": "sac"},
            "4,096 steps of 512 robots are 8 updates; --robots 68 there are 61",
        ),
    ],
)
def test_few_updates_are_said_with_the_robots_that_give_more(
    options: dict[str, Any], said: str
) -> None:
    hint = TrainingPlan.of(TrainingOptions(threads=1, **options)).update_hint
    assert hint.replace(" of the policy, few to learn from: with", ";") == said
    if said:
        robots = int(hint.partition("--robots ")[2].split()[0])
        more = TrainingPlan.of(TrainingOptions(threads=1, **options | {"robots": robots}))
        assert more.update_hint == ""


def test_the_measurement_is_within_what_there_is() -> None:
    assert 1 <= plan.measure_free_cores() <= usable_cores()
