"""Turn towards the goal and drive, whatever stands in the way: what an agent must beat at least.

    acsar-gym evaluate --policy agents/examples/head_for_goal.py:act --env point_goal --link planar

Any function from an observation to an action is a policy, as this one is. It knows the goal's
bearing and nothing else, so it shows how much of a task is avoiding obstacles. In 200 worlds of the
test split, on planar robots:

    point_goal       200/200 (100.0%)   SPL 1.00
    obstacle_goal     60/200  (30.0%)   SPL 0.30   (95 % interval 24 to 37 %)
    barn              22/200  (11.0%)   SPL 0.11   (95 % interval 7 to 16 %)
"""

from collections.abc import Sequence


def act(observation: Sequence[float]) -> tuple[float, float]:
    """Return linear and angular speed in [-1, 1]; `observation` begins as PointGoal's does."""
    return max(float(observation[1]), 0.0), float(observation[2])  # cosine and sine of the bearing
