"""The loop that calls a task's compiled methods for every robot.

`bind_task` makes copies of it in which the names `task_*` are the methods of one task. numba caches
a compiled copy beside the task's own file, under the name of the task's class.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numba import literal_unroll, types
from numpy.typing import NDArray

from acsar_gym.jit import jit, overloads
from acsar_gym.tasks.state import State
from acsar_gym.tasks.task import TASK_METHODS, Outcome, Task
from acsar_gym.vector.kernel.binding import bind_methods
from acsar_gym.vector.kernel.episode import update_info
from acsar_gym.vector.kernel.layout import BLOCK_ROBOTS, Records, Setup, Spawns, Tables

OUTCOMES = len(Outcome)

# Placeholders: in the copies that `bind_task` makes, these names are the task's compiled methods.
task_begin: Any = Task.begin
task_outcome: Any = Task.outcome
task_reward: Any = Task.reward
task_observe: Any = Task.observe


@jit
def state_of(tables: Tables, robot: int, setup: Setup, spawns: Spawns) -> State:
    """Make a robot's State, with the same fields as `RobotEnv` does."""
    robots = tables.blocks[robot // BLOCK_ROBOTS]
    i = robot % BLOCK_ROBOTS
    world = int(robots.world[i])
    kind = int(robots.kind[i])
    rays = int(robots.rays[i])
    speeds = robots.read_speed

    # The world's own path, unless the goal is elsewhere.
    path = spawns.paths[0, :0]
    if len(spawns.samples) > 0:
        path = spawns.paths[world, : spawns.samples[world]]
    length = np.nan
    if len(spawns.lengths) > 0 and robots.goal_given[i] == 0.0:
        length = spawns.lengths[world]

    return State(
        pose=(robots.odom_x[i], robots.odom_y[i], robots.odom_theta[i]),
        twist=(robots.linear[i], robots.angular[i]),
        wheel_speeds=(speeds[0, i], speeds[1, i], speeds[2, i], speeds[3, i]),
        action=(robots.action_linear[i], robots.action_angular[i]),
        sent=(robots.sent_linear[i], robots.sent_angular[i]),
        reason=int(robots.sent_reason[i]),
        ranges=tables.ranges[robot, :rays],
        edges=tables.edges[kind, :rays],
        sensed=tables.observations[robot, setup.numbers :],
        time=robots.steps[i] * setup.ticks * setup.period,
        feedback_age=robots.feedback_age[i],
        contact=robots.true_contact[i] > 0.0,
        goal=(robots.goal_x[i], robots.goal_y[i]),
        path=path,
        length=length,
        max_twist=(robots.max_linear[i], robots.max_angular[i]),
        period=setup.ticks * setup.period,
    )


def outcome_number(outcome: Any) -> int:
    """Return the number of an Outcome."""
    return int(outcome)


@overloads(outcome_number)
def _compile_outcome_number(outcome: Any) -> Callable[..., int]:
    """Compile it, also for numbers. True and False are refused: True would be a success."""

    def refuse(outcome: Any) -> int:
        # Always true, but numba needs a return to know the type of the result.
        if int(outcome) < OUTCOMES:
            raise ValueError("outcome returned True or False: must be an Outcome")
        return 0

    def number(outcome: Any) -> int:
        result: int = 0 + outcome
        return result

    return refuse if isinstance(outcome, types.Boolean) else number


@jit
def store_numbers(row: NDArray[np.float32], numbers: Any) -> None:
    """Write numbers, whose types may differ, into the first columns of a row."""
    column = 0
    for number in literal_unroll(
        (*numbers, 0.0)
    ):  # numba can't unroll an empty tuple, or enumerate
        if column < len(numbers):
            row[column] = number
        column += 1  # noqa: SIM113


def run(
    task: Any,
    memory: NDArray[Any],
    tables: Tables,
    first: int,
    last: int,
    setups: Records,
    spawns: Spawns,
) -> None:
    """Write reward, end and observation of the robots of blocks first to last.

    Args:
        task: The task's numbers.
        memory: A row for each robot, and a last one with the first values.
        tables: Robots in `begins` start an episode, those in `drives` go on.
        first: First block.
        last: Block after the last one.
        setups: What the robots share.
        spawns: Worlds of the batch.
    """
    setup = setups[0]
    for robot in range(first * BLOCK_ROBOTS, min(last * BLOCK_ROBOTS, len(tables.begins))):
        robots = tables.blocks[robot // BLOCK_ROBOTS]
        i = robot % BLOCK_ROBOTS
        begins = tables.begins[robot]
        if not (begins or tables.drives[robot]):
            continue

        if begins:
            memory[robot] = memory[len(memory) - 1]
        state = state_of(tables, robot, setup, spawns)
        remembered = memory[robot]
        if begins:
            task_begin(task, state, remembered)
            tables.rewards[robot] = 0.0
            tables.terminated[robot] = False
            tables.truncated[robot] = False
        else:
            outcome = outcome_number(task_outcome(task, state, remembered))
            if not 0 <= outcome < OUTCOMES:
                raise ValueError("outcome returned what is no Outcome")
            reward = task_reward(task, state, remembered, outcome)
            robots.outcome[i] = outcome
            robots.total_reward[i] += reward
            tables.rewards[robot] = reward
            tables.terminated[robot] = outcome != 0
            tables.truncated[robot] = robots.steps[i] >= setup.max_steps

        observed = task_observe(task, state, remembered)
        if len(observed) != setup.numbers:
            raise ValueError("observe returned more or fewer numbers than `observation` names")
        store_numbers(tables.observations[robot], observed)
    update_info(tables.blocks, first, last, setups)


def bind_task(task: Task) -> Callable[..., None]:
    """Make a copy of `run` that calls the methods of one task, compiled, see `bind_methods`."""
    return bind_methods(type(task), run, {f"task_{method}": method for method in TASK_METHODS})
