"""How soon the wheel check finds faults, and whether it stops sound robots: `make wheel-check`.

The first two tables show the time from the fault, or from the first command after it, to the error:
median and maximum for each rate of the feedback. The third table shows the errors of sound robots:
packaged policies drive each preset in each simulator, with drawn parameters, lost lines, and lags
and deadbands that the check doesn't know. Lines arrive up to 10 ms early or late.
"""

from __future__ import annotations

import contextlib
import itertools
import math
import statistics
import warnings
from collections.abc import Callable, Iterator
from typing import Any

import gymnasium
import numpy as np
from boards import FAULTS, FaultyBoard, make_fault
from rich.console import Console
from rich.table import Table

from acsar_gym import Robot, RobotConfig, open_link
from acsar_gym.errors import WheelError
from acsar_gym.physics.randomization import randomization_level
from acsar_gym.safety.wheel_check import WheelCheck
from acsar_gym.tools.policies import OnnxPolicy, resolve
from acsar_gym.tools.policies.policy import PolicyContext

PRESETS = ("acsar", "acsar_avr", "husky", "jackal")
BODIES = ("planar", "bullet", "mujoco")
RATES = (5.0, 10.0, 20.0, 50.0, 100.0)
POLICIES = {
    "point_goal": "PointGoal-v0",
    "obstacle_goal": "ObstacleGoal-v1",
    "path_follow": "PathFollow-v0",
    "barn": "Barn-v1",
    "crowd": "Crowd-v0",
    "dyna_barn": "DynaBarn-v0",
}
STEERING = ("point_goal", "obstacle_goal", "path_follow")
STRAIGHT = ((0.2, 0.0), (0.3, 0.0), (0.6, 0.0), (1.0, 0.0), (-0.5, 0.0))
CURVES = ((0.0, 0.5), (0.0, -1.0), (0.5, 0.4), (0.8, -0.5), (1.0, 0.5))
"""Steady drives, as shares of the full speeds."""
ROUNDS = 4  # of the steady drives. In half of them the fault happens while driving
POLICY_SEEDS = 8
FAULT_DELAY = (0.5, 2.0)  # range of the time from the first command to a fault while driving [s]
DURATION = 6.0  # of a steady drive [s]
PATIENCE = 3.0
"""A fault isn't found if a policy drives on for this long [s]. Shorter drives don't count."""
MOTORS: tuple[dict[str, float], ...] = (
    {"time_constant": 0.3},
    {"time_constant": 0.3, "deadband": 1.5},
)
"""Changes of the simulated motors, of which the check doesn't know."""
LEVEL = 2  # of the randomization
DROPPED = 0.02  # share of lines that sound robots lose
STEPS = 300  # longest episode of a sound robot


class CheckedLink(FaultyBoard):
    """A simulated robot whose link checks its wheels, with what is known of the robot."""

    is_real = False
    lateness = None

    def __init__(
        self, link: Any, rng: np.random.Generator, assumed: RobotConfig, **options: Any
    ) -> None:
        super().__init__(link, rng, **options)
        self._known = assumed
        self.error: WheelError | None = None

    def reset(self, scene: Any) -> None:
        super().reset(scene)
        self._check = WheelCheck(self._known)

    def advance(self, period: float) -> bytes:
        data = super().advance(period)
        try:
            self._check.tick(self.sent, self.measured, period, fresh=bool(data))
        except WheelError as error:
            self.error = error
            raise
        return data

    @property
    def delay(self) -> float:
        """Time from the fault to the error [s]. Infinite without an error."""
        return math.inf if self.error is None else self.now() - self.failed_at


def make_faulty(kind: str, config: RobotConfig, seed: int, *, driving: bool) -> CheckedLink:
    """Make a robot with a fault from its first command, or while it is driving."""
    rng = np.random.default_rng(seed)
    fault = make_fault(kind, wheel=int(rng.integers(4)))
    delay = rng.uniform(*FAULT_DELAY) if driving else 0.0
    return CheckedLink(open_link("planar", config), rng, config, fault=fault, after=delay)


def check_steady(kind: str, config: RobotConfig) -> Iterator[float]:
    """Yield the times until a fault is found in steady drives [s]."""
    twists = CURVES if kind == "swapped sides" else STRAIGHT + CURVES
    for seed, (linear, angular) in enumerate(twists * ROUNDS):
        link = make_faulty(kind, config, seed, driving=seed >= 2 * len(twists))
        with Robot(link, config) as robot, contextlib.suppress(WheelError):
            for _ in range(seed % 20):
                robot.drive(0.0, 0.0)
            for _ in range(round(DURATION / config.period)):
                robot.drive(linear * config.max_linear, angular * config.max_angular)
        yield link.delay


def check_policies(kind: str, config: RobotConfig) -> Iterator[float]:
    """Yield the times until a fault is found while policies drive [s]."""
    for name, seed in itertools.product(STEERING, range(POLICY_SEEDS)):
        link = make_faulty(kind, config, seed, driving=seed % 2 == 1)
        end = drive_policy(name, link, config, seed)
        if link.error is not None or end - link.failed_at > PATIENCE:
            yield link.delay


def drive_policy(
    name: str, link: CheckedLink, config: RobotConfig, seed: int, **options: Any
) -> float:
    """Drive a packaged policy for an episode, and return its duration [s]."""
    policy = OnnxPolicy(resolve(name))
    env = gymnasium.make(f"acsar_gym/{POLICIES[name]}", link=link, robot=config, **options)
    inner: Any = env.unwrapped
    policy.bind(PolicyContext.of(inner))
    observation, _ = env.reset(seed=seed)
    policy.reset()
    for _ in range(STEPS):
        observation, _, terminated, truncated, _ = env.step(policy(observation))
        if terminated or truncated:
            break

    duration = link.now()
    env.close()
    return duration


def show_times(title: str, measure: Callable[[str, RobotConfig], Iterator[float]]) -> None:
    """Measure and print the times for each fault and rate."""
    rates = [f"{rate:g} Hz" for rate in RATES]
    table = Table("fault", *rates, title=f"{title}: median, maximum [s]")
    for kind in FAULTS:
        row = []
        for rate in RATES:
            changes = {"firmware": {"feedback_rate": rate}, "feedback_timeout": 2.0}
            times = [*measure(kind, RobotConfig.preset("acsar").with_(**changes))]
            row.append(f"{statistics.median(times):.2f}, {max(times):.2f}")
        table.add_row(kind, *row)
    Console(width=110).print(table)


def show_errors(body: str) -> None:
    """Let policies drive sound robots in a simulator, and print the errors."""
    table = Table("robot", "episodes", "minutes", "errors", title=f"sound robots: {body}")
    for preset in PRESETS:
        assumed = RobotConfig.preset(preset)
        minutes = 0.0
        errors = []
        cases = list(itertools.product(POLICIES, RATES, MOTORS))
        for seed, (name, rate, motor) in enumerate(cases):
            window = min(1.0 / rate, 0.2) if seed % 2 else 0.05
            config = assumed.with_(
                firmware={"feedback_rate": rate},
                encoder={"window": window},
                motor=motor,
                feedback_timeout=2.0,
            )

            rng = np.random.default_rng(seed)
            link = CheckedLink(open_link(body, config), rng, assumed, dropped=DROPPED)
            drawn = randomization_level(config, LEVEL)
            minutes += drive_policy(name, link, config, seed, randomization=drawn) / 60.0
            if link.error is not None:
                errors.append(f"{name} at {rate:g} Hz: {link.error.found}")
        report = "\n".join([str(len(errors)), *errors])
        table.add_row(preset, str(len(cases)), f"{minutes:.0f}", report)
    Console(width=110).print(table)


if __name__ == "__main__":
    warnings.simplefilter("ignore")
    show_times("steady drives", check_steady)
    show_times("packaged policies", check_policies)
    for body in BODIES:
        show_errors(body)
