"""Model predictive path integral control on the planar twin's own model.

Williams, Drews, Goldfain, Rehg & Theodorou, "Information-theoretic model predictive control", IEEE
Transactions on Robotics 34 (2018).

Every step, the plan of the last one is shifted by a step, and rollouts of it with Gaussian noise on
its commands are simulated: command limits, the firmware's ramp, motors and tyres as in `dynamics`,
with larger substeps. The new plan is their mean, weighted by exp(-cost / TEMPERATURE). A rollout's
cost is that of the way left at its end, by the navigation function of the kept map, and of
nearness, collisions, reverse driving and changes of the commands on the way.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from acsar_gym.config import RobotConfig
from acsar_gym.jit import jit, loop
from acsar_gym.physics.model import Physics, compute_physics, tyre_step, wheel_speed
from acsar_gym.safety.rules import read_limits
from acsar_gym.tasks.base import Floats
from acsar_gym.tools.baselines.mapping import (
    MappedPolicy,
    MotionState,
    Pose,
    Surroundings,
    in_goal,
    pose_clearance,
    way_left,
)
from acsar_gym.tools.policies.base import DecodedObservation, PolicyContext

ROLLOUTS = 300
PLAN_STEPS = 20
"""Policy steps that are looked ahead."""
MODEL_SUBSTEP = 0.02
"""Step of the model in a rollout [s]."""
ACTION_NOISE = (0.35, 0.6)
"""Standard deviation of the noise on the linear and the angular action."""
NOISE_CORRELATION = 0.6
"""Correlation of the noise from one step to the next."""
TEMPERATURE = 0.04
"""Costs that differ by this count e times less [m]."""
ROLLOUT_NOSE = 0.2
"""The navigation function counts this far ahead of the robot, so that its heading matters [m]."""
NEARNESS_COST, NEARNESS_FADE = 0.5, 0.06
"""Cost of a second without clearance [m/s], and the clearance where it has fallen to 1/e [m]."""
CRASH_CLEARANCE = 0.02
"""Clearance below which a rollout counts as a collision [m]."""
CRASH_COST = 5.0
"""Cost of a collision, plus what the steps left would cost [m]."""
REVERSE_COST = 0.3
"""Cost of a second of reverse driving at full speed [m/s]."""
CHANGE_COST = 0.004
"""Cost of changing an action by 1 [m]."""
TIME_COST = 0.1
"""Cost of a second until the goal is reached [m/s]."""


class RolloutModel(NamedTuple):
    """The robot's numbers in rollouts."""

    own: Physics
    fastest: float
    """Velocity of a full action [m/s], with the next one [rad/s]."""
    turning: float
    rise: float
    """Greatest change of the linear command in a substep [m/s], of the angular one [rad/s], and of
    a wheel's set point [rad/s]."""
    spin: float
    ramp: float
    separation: float
    """Effective wheel separation, by which commands become wheel speeds [m]."""
    substeps: int
    """In a policy step."""
    dt: float
    """Substep [s]."""


def make_model(config: RobotConfig, period: float) -> RolloutModel:
    """Make the model of a robot for a policy period [s]."""
    substeps = max(1, round(period / MODEL_SUBSTEP))
    dt = period / substeps
    motors = [config.motor.of_wheel(wheel) for wheel in range(4)]
    blends = [
        1.0 - math.exp(-dt / m.time_constant) if m.time_constant > 0.0 else 1.0 for m in motors
    ]
    named = {f"blend_{w}": blend for w, blend in zip("abcd", blends, strict=True)}
    return RolloutModel(
        compute_physics(config)._replace(**named),
        config.max_linear,
        config.max_angular,
        read_limits(config.linear_limits).max_acceleration * dt,
        read_limits(config.angular_limits).max_acceleration * dt,
        min(motor.acceleration for motor in motors) * dt,
        config.effective_separation,
        substeps,
        dt,
    )


class Mppi(MappedPolicy):
    """Samples plans around the last one, and takes their mean weighted by how good they are."""

    name = "mppi"

    def equip(self, setting: PolicyContext) -> None:
        """Prepare for a robot and a task."""
        self._model = make_model(setting.config, setting.period)
        super().equip(setting)

    def reset(self) -> None:
        """Forget map, motion and plan."""
        super().reset()
        self._actions = np.zeros((PLAN_STEPS, 2))

    def decide(
        self, pose: Pose, goal: tuple[float, float], seen: DecodedObservation
    ) -> tuple[float, float]:
        """Return the first command of the new plan [m/s, rad/s]."""
        config = self.setting.config
        reach = config.max_linear * PLAN_STEPS * self.setting.period
        around = self.around(pose, reach, goal, self.setting.tolerance)
        self._actions = np.vstack([self._actions[1:], self._actions[-1:]])
        noise = self.rng.standard_normal((ROLLOUTS, PLAN_STEPS, 2))
        for step in range(1, PLAN_STEPS):
            fresh = math.sqrt(1.0 - NOISE_CORRELATION**2) * noise[:, step]
            noise[:, step] = NOISE_CORRELATION * noise[:, step - 1] + fresh
        tried = np.clip(self._actions + noise * ACTION_NOISE, -1.0, 1.0)
        tried[0] = self._actions
        tried[1] = 0.0
        state = (*pose, seen.linear, seen.angular, *self.sent)
        costs = cost_rollouts(tried, state, self._model, around)
        weights = np.exp(-(costs - costs.min()) / TEMPERATURE)
        self._actions = np.einsum("n,nsa->sa", weights / weights.sum(), tried)
        linear, angular = self._actions[0].tolist()
        return linear * config.max_linear, angular * config.max_angular


WheelState = tuple[float, float, float, float]
"""Speeds of the right and the left wheels, and the firmware's set points of them [rad/s]."""


@jit
def wheel_speeds(linear: float, angular: float, model: RolloutModel) -> tuple[float, float]:
    """Speeds of the right and the left wheels for a twist [rad/s]."""
    half = angular * model.separation / 2.0
    return (linear + half) / model.own.right_radius, (linear - half) / model.own.left_radius


@jit
def advance_robot(
    v: tuple[float, float, float],
    drive: WheelState,
    linear: float,
    angular: float,
    model: RolloutModel,
) -> tuple[tuple[float, float, float], WheelState]:
    """Advance body and wheels by a substep.

    Args:
        v: velocity of the body: ahead, left [m/s], yaw rate [rad/s].
        drive: of the wheels.
        linear: command [m/s].
        angular: command [rad/s].
        model: of the robot.

    Returns:
        Velocity and wheels after it.
    """
    own, (right, left, set_right, set_left) = model.own, drive
    wanted = wheel_speeds(linear, angular, model)
    set_right += min(max(wanted[0] - set_right, -model.ramp), model.ramp)
    set_left += min(max(wanted[1] - set_left, -model.ramp), model.ramp)
    right = wheel_speed(right, set_right, own.gain_a, own.blend_a, own.deadband_a, own.max_speed)
    left = wheel_speed(left, set_left, own.gain_b, own.blend_b, own.deadband_b, own.max_speed)
    after = tyre_step(v[0], v[1], v[2], (right, left, left, right), own, own.kappa, model.dt)
    return after, (right, left, set_right, set_left)


@loop
def simulate_rollout(
    actions: Floats, start: MotionState, model: RolloutModel, poses: Floats
) -> None:
    """Simulate a rollout.

    Args:
        actions: (steps, 2), in [-1, 1].
        start: the state now.
        model: of the robot.
        poses: (steps, 3): is set to x [m], y [m], theta [rad] after each step.
    """
    x, y, theta, linear, angular, sent_v, sent_w = start
    right, left = wheel_speeds(linear, angular, model)
    set_right, set_left = wheel_speeds(sent_v, sent_w, model)
    drive, velocity = (right, left, set_right, set_left), (linear, 0.0, angular)
    for step in range(len(actions)):
        wanted_v, wanted_w = actions[step, 0] * model.fastest, actions[step, 1] * model.turning
        for _ in range(model.substeps):
            sent_v += min(max(wanted_v - sent_v, -model.rise), model.rise)
            sent_w += min(max(wanted_w - sent_w, -model.spin), model.spin)
            velocity, drive = advance_robot(velocity, drive, sent_v, sent_w, model)
            theta += velocity[2] * model.dt
            cos, sin = math.cos(theta), math.sin(theta)
            x += (cos * velocity[0] - sin * velocity[1]) * model.dt
            y += (sin * velocity[0] + cos * velocity[1]) * model.dt
        poses[step, 0], poses[step, 1], poses[step, 2] = x, y, theta


@loop
def cost_rollouts(
    tried: Floats, start: MotionState, model: RolloutModel, around: Surroundings
) -> Floats:
    """Simulate rollouts and sum up their costs.

    Args:
        tried: (rollouts, steps, 2): actions in [-1, 1].
        start: the state now.
        model: of the robot.
        around: of the robot.

    Returns:
        (rollouts,): costs in equivalent metres.
    """
    costs, poses = np.empty(len(tried)), np.empty((tried.shape[1], 3))
    span = model.substeps * model.dt
    sent = (start[5] / model.fastest, start[6] / model.turning)
    for n in range(len(tried)):
        simulate_rollout(tried[n], start, model, poses)
        costs[n] = action_cost(tried[n], sent, span) + pose_cost(poses, around, span)
    return costs


@jit
def action_cost(actions: Floats, sent: tuple[float, float], span: float) -> float:
    """Cost of changing actions, and of driving backwards.

    Args:
        actions: (steps, 2).
        sent: the action before them.
        span: duration of a step [s].
    """
    cost, (last_v, last_w) = 0.0, sent
    for step in range(len(actions)):
        v, w = actions[step, 0], actions[step, 1]
        cost += CHANGE_COST * ((v - last_v) ** 2 + (w - last_w) ** 2) + REVERSE_COST * span * max(
            -v, 0.0
        )
        last_v, last_w = v, w
    return cost


@loop
def pose_cost(poses: Floats, around: Surroundings, span: float) -> float:
    """Cost of a rollout's poses, (steps, 3), that take `span` [s] each; see `rolled`."""
    cost, count = 0.0, len(poses)
    for step in range(count):
        x, y, theta = poses[step, 0], poses[step, 1], poses[step, 2]
        free = pose_clearance(x, y, theta, around, 0.3)
        cost += span * (TIME_COST + NEARNESS_COST * math.exp(-free / NEARNESS_FADE))
        if free < CRASH_CLEARANCE:
            cost += CRASH_COST * (1.0 - 0.5 * step / count)
            break
        if in_goal(x, y, around):
            return cost
    return cost + way_left(x, y, theta, ROLLOUT_NOSE, around)
