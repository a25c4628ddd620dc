"""Compares the bundle of a policy with the env that it is to drive in.

What must match is what its numbers mean: names, ranges and scale of the observation, the layout of
its sensors, the action, and the policy rate. A robot may differ, because actions and observed
speeds are relative to its own limits. That is told where its limits, its footprint or its LiDAR
differ, or its physics lies outside of the ranges of the training.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence

from acsar_gym.config import RobotConfig
from acsar_gym.errors import PolicyError, printable, shortened
from acsar_gym.policies import describing, trained
from acsar_gym.policies.bundle import Action, Bundle, Observation, Value
from acsar_gym.sensors import Sensor
from acsar_gym.tasks import Task
from acsar_gym.tasks.made import named

LAYOUT = ("lidar.rays", "lidar.field_of_view", "lidar.max_range")
"""Values of a robot that an observation is made with."""
TOLD = {
    "max_linear": 0.0,
    "max_angular": 0.0,
    "linear_limits.max_acceleration": 0.0,
    "angular_limits.max_acceleration": 0.0,
    "lidar.min_range": 0.01,
    "lidar.rate": 0.0,
    "lidar_x_offset": 0.01,
    "lidar_y_offset": 0.01,
    "footprint.radius": 0.01,
}
"""Values of a robot that are told where they differ, and by how much they may [m]."""
TRAIN = "train it again, or choose the robot of its training with --robot"
MOST_TOLD = 100
"""Longest text from a file in a message [characters]."""
ARGUMENTS = "give the env the arguments that the policy was trained with"


def check(
    bundle: Bundle,
    task: Task,
    sensors: Sequence[Sensor],
    config: RobotConfig | None = None,
    rate: float | None = None,
) -> None:
    """Check that a policy can drive in an env.

    Args:
        bundle: of the policy.
        task: of the env.
        sensors: of the env, in the order of the observation.
        config: of the robot; None to skip what only it tells.
        rate: policy steps per second of the env [Hz]; None to skip it.

    Raises:
        PolicyError: names the first field that doesn't match; the message doesn't name the file.
    """
    here, file = named(task), bundle.robot.values
    own = {} if config is None else describing.values(config, sensors)
    for name in LAYOUT:
        if name in file and name in own and not trained.equal(file[name], own[name]):
            raise _unlike(
                name, trained.shown(file[name]), trained.shown(own[name]), "on this robot", TRAIN
            )
    _check_observation(bundle, describing.observation(task, sensors), here)
    if _action(bundle.action) != _action(Action()):
        raise _unlike("action", _action(bundle.action), _action(Action()), f"in {here}", TRAIN)
    if rate is not None and not trained.equal(bundle.rates.policy, rate):
        raise _unlike(
            "rates.policy", f"{bundle.rates.policy:g}", f"{rate:g}", f"in this {here}", ARGUMENTS
        )


def _check_observation(bundle: Bundle, own: Observation, here: str) -> None:
    """Compare the observation of a file with that of an env; PolicyError where they differ."""
    file = bundle.observation
    pairs = itertools.zip_longest(_parts(file), _parts(own), fillvalue="nothing")
    for number, (said, wanted) in enumerate(pairs):
        if said != wanted:
            raise _unlike(f"observation[{number}]", _quoted(said), wanted, f"in {here}", TRAIN)
    for number, name in enumerate(file.names):
        ends = [(seen.low[number], seen.high[number]) for seen in (file, own)]
        if ends[0] != ends[1]:
            raise _unlike(
                f"observation.{_quoted(name)}", _span(ends[0]), _span(ends[1]), f"in {here}", TRAIN
            )
    sizes = [tuple(sensor.size for sensor in seen.sensors) for seen in (file, own)]
    if sizes[0] != sizes[1]:
        raise _unlike(
            "observation.sensors", f"{sizes[0]} numbers", f"{sizes[1]}", f"in {here}", TRAIN
        )
    if not trained.equal(file.scale, own.scale):
        told = [trained.shown(seen.scale) for seen in (file, own)]
        raise _unlike("observation.scale", told[0], told[1], f"in this {here}", ARGUMENTS)


def _parts(seen: Observation) -> list[str]:
    """Return the names of an observation's numbers, and the layouts of its sensors."""
    return [*seen.names, *(sensor.layout for sensor in seen.sensors)]


def differences(bundle: Bundle, sensors: Sequence[Sensor], config: RobotConfig) -> list[str]:
    """Say how a robot differs from those of the training, one line for each field.

    Args:
        bundle: of the policy, which `check` has accepted.
        sensors: of the env.
        config: of the robot.
    """
    own = describing.values(config, sensors) | {"rates.control": config.control_rate}
    file = bundle.robot.values | {"rates.control": bundle.rates.control}
    lines = [
        f"{name} was {trained.shown(file[name])} in the training and is {trained.shown(own[name])} "
        "on this robot"
        for name, most in (*TOLD.items(), ("rates.control", 0.0))
        if name in file and name in own and not trained.equal(file[name], own[name], most)
    ]
    lines += trained.outside(bundle, own)
    return [f"{line}: it may drive worse than it was measured to" for line in lines]


def _unlike(name: str, file: str, own: str, where: str, fix: str) -> PolicyError:
    """Build the error for a field that doesn't match."""
    return PolicyError(f"{name} is {file} in the file and {own} {where}: {fix}")


def _quoted(text: str) -> str:
    """Return text from a file as one short line without control characters."""
    return printable(shortened(text, MOST_TOLD))


def _span(ends: tuple[Value, Value]) -> str:
    return " to ".join(trained.shown(end) for end in ends)


def _action(action: Action) -> str:
    """Format names, ranges and units of an action."""
    parts = zip(action.names, action.low, action.high, action.units, strict=False)
    return ", ".join(
        f"{_quoted(name)} {low:g} to {high:g} {_quoted(unit)}" for name, low, high, unit in parts
    )
