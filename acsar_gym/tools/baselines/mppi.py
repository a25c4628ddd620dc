"""Model predictive path integral control on the planar twin's own model.

Williams, Drews, Goldfain, Rehg & Theodorou, "Information-theoretic model predictive control", IEEE
Transactions on Robotics 34 (2018).

Every step, the plan of the last one is shifted by a step, and rollouts of it with Gaussian noise on
its commands are simulated: command limits, the firmware's ramp, motors and tyres as in `dynamics`,
with larger substeps. The new plan is their mean, weighted by exp(-cost / temperature). A rollout's
cost is that of the way left at its end, by the navigation function of the kept map, and of
nearness, collisions, reverse driving and changes of the commands on the way.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from acsar_gym.config import RobotConfig
from acsar_gym.jit import jit, loop
from acsar_gym.physics.model import Physics, compute_physics, tyre_step, wheel_speed
from acsar_gym.safety.rules import read_limits
from acsar_gym.tasks.state import Floats
from acsar_gym.tools.baselines.mapping import (
    MapConstants,
    MappedPolicy,
    MotionState,
    Pose,
    Surroundings,
    in_goal,
    pose_clearance,
    way_left,
)
from acsar_gym.tools.baselines.tuning import RobotUnits, constant
from acsar_gym.tools.policies.policy import DecodedObservation, PolicyContext

ROLLOUTS = 300
MODEL_SUBSTEP = 0.02
"""Step of the model in a rollout [s]."""
CHECK_SPACING = 0.5
"""Greatest distance between two poses of a rollout that are checked for collisions [radius]."""


@dataclass(frozen=True)
class MppiConstants(MapConstants):
    """Constants of model predictive path integral control."""

    horizon: float = constant(2.0, 0.8, 3.0)
    """How far is looked ahead [s]."""
    linear_noise: float = constant(0.35, 0.1, 1.0)
    """Standard deviation of the noise on the linear action, and on the angular one."""
    angular_noise: float = constant(0.6, 0.15, 1.2)
    noise_correlation: float = constant(0.6, 0.3, 0.95)
    """Correlation of the noise from one step to the next."""
    temperature: float = constant(0.08, 0.01, 0.5)
    """Costs that differ by this count e times less [s at top speed]."""
    nose: float = constant(0.83, 0.2, 4.0)
    """The navigation function counts this far ahead of the robot, so that its heading matters
    [radius]."""
    near_cost: float = constant(1.0, 0.1, 5.0)
    """Cost of a second without clearance [s at top speed]."""
    near_fade: float = constant(0.25, 0.1, 1.0)
    """Clearance where that cost has fallen to 1/e [radius]."""
    crash_clearance: float = constant(0.083, 0.03, 0.4)
    """Clearance below which a rollout counts as a collision [radius]."""
    crash_cost: float = constant(10.0, 2.0, 40.0)
    """Cost of a collision, plus what the steps left would cost [s at top speed]."""
    reverse_cost: float = constant(0.6, 0.1, 2.0)
    """Cost of a second of reverse driving at full speed [s at top speed]."""
    change_cost: float = constant(0.008, 0.001, 0.1)
    """Cost of changing an action by 1 [s at top speed]."""
    time_cost: float = constant(0.2, 0.02, 1.0)
    """Cost of a second until the goal is reached [s at top speed]."""


class RolloutModel(NamedTuple):
    """The robot and the constants in rollouts, in SI units."""

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
    checks: int
    """Poses in a policy step that are checked for collisions, of which `substeps` is a multiple."""
    nose: float
    """[m]."""
    reach: float
    """Clearance from which more makes no difference [m]."""
    near_cost: float
    """[m/s]."""
    near_fade: float
    """[m]."""
    crash_clearance: float
    """[m]."""
    crash_cost: float
    """[m]."""
    reverse_cost: float
    """[m/s]."""
    change_cost: float
    """[m]."""
    time_cost: float
    """[m/s]."""


def make_model(config: RobotConfig, units: RobotUnits, constants: MppiConstants) -> RolloutModel:
    """Make the model of a robot.

    Args:
        config: of the robot.
        units: of the robot.
        constants: of the costs.
    """
    k, (radius, speed) = constants, (units.radius, units.speed)
    checks = math.ceil(speed * units.period / (CHECK_SPACING * radius))
    substeps = checks * max(1, round(units.period / MODEL_SUBSTEP / checks))
    dt = units.period / substeps
    motors = [config.motor.of_wheel(wheel) for wheel in range(4)]
    blends = [
        1.0 - math.exp(-dt / m.time_constant) if m.time_constant > 0.0 else 1.0 for m in motors
    ]
    named = {f"blend_{w}": blend for w, blend in zip("abcd", blends, strict=True)}
    return RolloutModel(
        own=compute_physics(config)._replace(**named),
        fastest=config.max_linear,
        turning=config.max_angular,
        rise=read_limits(config.linear_limits).max_acceleration * dt,
        spin=read_limits(config.angular_limits).max_acceleration * dt,
        ramp=min(motor.acceleration for motor in motors) * dt,
        separation=config.effective_separation,
        substeps=substeps,
        dt=dt,
        checks=checks,
        nose=k.nose * radius,
        reach=4.0 * k.near_fade * radius,
        near_cost=k.near_cost * speed,
        near_fade=k.near_fade * radius,
        crash_clearance=k.crash_clearance * radius,
        crash_cost=k.crash_cost * speed,
        reverse_cost=k.reverse_cost * speed,
        change_cost=k.change_cost * speed,
        time_cost=k.time_cost * speed,
    )


class Mppi(MappedPolicy):
    """Samples plans around the last one, and takes their mean weighted by how good they are."""

    name = "mppi"
    constants_type = MppiConstants
    constants: MppiConstants

    def equip(self, setting: PolicyContext) -> None:
        """Prepare for a robot and a task."""
        super().equip(setting)
        self._model = make_model(setting.config, self.units, self.constants)

    def reset(self) -> None:
        """Forget map, motion and plan."""
        super().reset()
        steps = self.units.steps(self.constants.horizon, self.units.period)
        self._actions = np.zeros((steps, 2))

    def decide(
        self, pose: Pose, goal: tuple[float, float], seen: DecodedObservation
    ) -> tuple[float, float]:
        """Return the first command of the new plan [m/s, rad/s]."""
        model, k = self._model, self.constants
        ahead = model.fastest * k.horizon + model.nose
        around = self.around(pose, ahead + self.outer + model.reach, goal, self.setting.tolerance)
        self._actions = np.vstack([self._actions[1:], self._actions[-1:]])
        noise = self.rng.standard_normal((ROLLOUTS, *self._actions.shape))
        for step in range(1, len(self._actions)):
            fresh = math.sqrt(1.0 - k.noise_correlation**2) * noise[:, step]
            noise[:, step] = k.noise_correlation * noise[:, step - 1] + fresh
        spread = (k.linear_noise, k.angular_noise)
        tried = np.clip(self._actions + noise * spread, -1.0, 1.0)
        tried[0] = self._actions
        tried[1] = 0.0
        state = (*pose, seen.linear, seen.angular, *self.sent)
        costs = cost_rollouts(tried, state, model, around)
        weights = np.exp(-(costs - costs.min()) / (k.temperature * model.fastest))
        self._actions = np.einsum("n,nsa->sa", weights / weights.sum(), tried)
        linear, angular = self._actions[0].tolist()
        return linear * model.fastest, angular * model.turning


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
        poses: (steps * checks, 3): is set to x [m], y [m], theta [rad] at each check.
    """
    x, y, theta, linear, angular, sent_v, sent_w = start
    right, left = wheel_speeds(linear, angular, model)
    set_right, set_left = wheel_speeds(sent_v, sent_w, model)
    drive, velocity = (right, left, set_right, set_left), (linear, 0.0, angular)
    every = model.substeps // model.checks
    for step in range(len(actions)):
        wanted_v, wanted_w = actions[step, 0] * model.fastest, actions[step, 1] * model.turning
        for substep in range(model.substeps):
            sent_v += min(max(wanted_v - sent_v, -model.rise), model.rise)
            sent_w += min(max(wanted_w - sent_w, -model.spin), model.spin)
            velocity, drive = advance_robot(velocity, drive, sent_v, sent_w, model)
            theta += velocity[2] * model.dt
            cos, sin = math.cos(theta), math.sin(theta)
            x += (cos * velocity[0] - sin * velocity[1]) * model.dt
            y += (sin * velocity[0] + cos * velocity[1]) * model.dt
            if (substep + 1) % every == 0:
                check = step * model.checks + substep // every
                poses[check, 0], poses[check, 1], poses[check, 2] = x, y, theta


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
    costs, poses = np.empty(len(tried)), np.empty((tried.shape[1] * model.checks, 3))
    sent = (start[5] / model.fastest, start[6] / model.turning)
    for n in range(len(tried)):
        simulate_rollout(tried[n], start, model, poses)
        costs[n] = action_cost(tried[n], sent, model) + pose_cost(poses, around, model)
    return costs


@jit
def action_cost(actions: Floats, sent: tuple[float, float], model: RolloutModel) -> float:
    """Cost of changing actions, and of driving backwards.

    Args:
        actions: (steps, 2).
        sent: the action before them.
        model: of the robot.
    """
    cost, (last_v, last_w) = 0.0, sent
    span = model.substeps * model.dt
    for step in range(len(actions)):
        v, w = actions[step, 0], actions[step, 1]
        cost += model.change_cost * ((v - last_v) ** 2 + (w - last_w) ** 2)
        cost += model.reverse_cost * span * max(-v, 0.0)
        last_v, last_w = v, w
    return cost


@loop
def pose_cost(poses: Floats, around: Surroundings, model: RolloutModel) -> float:
    """Cost of a rollout's poses, (steps * checks, 3); see `simulate_rollout`."""
    cost, count = 0.0, len(poses)
    span = model.substeps * model.dt / model.checks
    for check in range(count):
        x, y, theta = poses[check, 0], poses[check, 1], poses[check, 2]
        free = pose_clearance(x, y, theta, around, model.reach)
        cost += span * (model.time_cost + model.near_cost * math.exp(-free / model.near_fade))
        if free < model.crash_clearance:
            cost += model.crash_cost * (1.0 - 0.5 * check / count)
            break
        if in_goal(x, y, around):
            return cost
    return cost + way_left(x, y, theta, model.nose, around)
