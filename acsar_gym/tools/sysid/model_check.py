"""Whether a fitted model describes a board, and what it misses where it doesn't.

The error on lines that the fit didn't see is compared with the noise: the steps of the printed
numbers, and what the phases of the board's loops do to the time of an answer. Where the error is
larger, freer models are fitted to the wheel that is missed most, each with one habit more (another
gain backward, a hold at reversals, an overshoot ...). The habit that explains most of it is named.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from itertools import product
from typing import NamedTuple

import numpy as np

from acsar_gym.config import RobotConfig
from acsar_gym.errors import require_extra
from acsar_gym.jit import loop
from acsar_gym.protocol import MOTORS
from acsar_gym.tools.doctor.board import HIGHEST_RATIO, LOWEST_RATIO
from acsar_gym.tools.doctor.commission import likely_units
from acsar_gym.tools.sysid.delays import Floats
from acsar_gym.tools.sysid.feedback_lines import PRINTED_STEP, measure_line_rate
from acsar_gym.tools.sysid.fit import MotorFit
from acsar_gym.tools.sysid.response import FitProblem, WheelModel, lag_blend, sample_commands
from acsar_gym.tools.sysid.tracks import BoardTrack

with require_extra("identification", "scipy"):
    from scipy import optimize

FITS = "fits"
"""What a robot's file says of a model that fits; otherwise `MISFIT` and the pattern."""
MISFIT = "doesn't fit: "
ERROR_LIMIT = 2.0
"""A model doesn't fit where its error is more than this, in noises."""
WORST_SHARE = 0.01
"""Share of lines, the worst, that may be damaged and don't count."""
CALM_TIME, CALM_RANGE = 0.5, 1.0
"""Lines show their noise where commands changed less than this [rad/s] for such a time [s]."""
FEWEST_CALM = 30
"""Fewest such lines that tell the noise."""
EXPLAINED_SHARE = 0.5
"""A habit is named that explains this share of the squared error."""
EVALUATIONS = 300
"""Evaluations of a freer model, at most."""
STEP_TIME = 0.4
"""Lines so soon after a jump of the command are of its answer [s]."""
STEP_JUMP = 1.0
"""Smallest change of a command from line to line that counts as a jump [rad/s]."""


class ModelCheck(NamedTuple):
    """The error of a model on lines that the fit didn't see, against their noise."""

    error: float
    """Of the wheel that is missed most, RMS [rad/s]."""
    noise: float
    """Of the same lines, RMS [rad/s]."""
    pattern: str
    """What the model misses; empty where it fits."""

    @property
    def verdict(self) -> str:
        """What the robot's file says."""
        return MISFIT + self.pattern if self.pattern else FITS


class Habits(NamedTuple):
    """A wheel's answer, with habits that the twin's motors don't have."""

    lag: float
    gain: float
    slowness: float
    deadband: float
    delay: float
    backward: float = 1.0
    """Factor on the gain backward."""
    top: float = 1e3
    """Speed at which it saturates [rad/s]."""
    hold: float = 0.0
    """Time for which it stands at each change of sign [s]."""
    overshoot: float = 0.0
    """Share of a step by which it overshoots."""
    braking: float = 1.0
    """Factor on the lag where it slows down."""
    bend: float = 0.0
    """Share of the gain that is lost at 10 rad/s, in proportion to the speed."""
    stiction: float = 0.0
    """By how much more set point it needs to start than to go on [rad/s]."""


HABIT_STARTS: dict[str, tuple[float, ...]] = {
    "backward": (0.85, 1.15),
    "top": (0.9, 0.6),
    "hold": (0.1, 0.25),
    "overshoot": (0.1, 0.3),
    "braking": (0.4, 2.5),
    "bend": (0.15,),
    "stiction": (0.4,),
}
"""Values from which the fit of each habit starts; that of `top` is a share of the fastest line."""


@loop
def simulate_habits(targets: Floats, dt: float, own: Habits) -> Floats:
    """Compute a wheel's speed after each loop, with its habits.

    Args:
        targets: commanded in each loop [rad/s].
        dt: period of the loop [s].
        own: the wheel's answer.
    """
    step = dt / max(own.slowness, 1e-6)
    lag = max(own.lag, 1e-3)
    blend = 1.0 - math.exp(-dt / lag)
    brake = 1.0 - math.exp(-dt / max(lag * own.braking, 1e-3))
    log = math.log(max(own.overshoot, 1e-6))
    damping = -log / math.sqrt(math.pi**2 + log * log)
    natural = min(1.0 / (2.0 * damping * lag), 1.0 / dt)
    speeds = np.empty(len(targets))
    set_point, speed, rate, sign, held, moving = 0.0, 0.0, 0.0, 0.0, 1e9, False
    for k in range(len(targets)):
        target = targets[k]
        if target * sign < 0.0:
            held = 0.0
        if target != 0.0:
            sign = 1.0 if target > 0.0 else -1.0
        held += dt
        if held <= own.hold:
            target = 0.0
        set_point = min(max(target, set_point - step), set_point + step)
        aim = set_point * own.gain
        if aim < 0.0:
            aim *= own.backward
        aim *= 1.0 - min(0.9, own.bend * abs(aim) / 10.0)
        if abs(aim) < own.deadband + (0.0 if moving else own.stiction):
            aim = 0.0
        moving = aim != 0.0
        aim = min(max(aim, -own.top), own.top)
        if own.overshoot > 1e-3:
            rate += (natural * (aim - speed) - 2.0 * damping * rate) * natural * dt
            speed += rate * dt
        else:
            speed += (brake if abs(aim) < abs(speed) else blend) * (aim - speed)
        speeds[k] = speed
    return speeds


def check_model(fit: MotorFit, config: RobotConfig) -> ModelCheck | None:
    """Check whether a fitted model describes the board.

    Args:
        fit: of the motors.
        config: of the robot, as it was.

    Returns:
        The check; None where no lines were held out.
    """
    held_out = replace(fit.problem, held_out=True, kept={})
    if not held_out.count:
        return None
    problem = held_out
    errors, noises = [], []
    for k, model in enumerate(fit.wheels):
        rest = problem.residuals_of(k, model, fit.times)
        noise = _estimate_noise(fit, problem, k)
        usual = np.argsort(np.abs(rest) / noise)[: math.ceil((1.0 - WORST_SHARE) * len(rest))]
        errors.append(float(np.sqrt(np.mean(rest[usual] ** 2))))
        noises.append(float(np.sqrt(np.mean(noise[usual] ** 2))))
    worst = int(np.argmax(np.array(errors) / noises))
    scale = _describe_scale(fit, config)
    pattern = scale
    if not scale and errors[worst] > ERROR_LIMIT * noises[worst]:
        pattern = _find_habit(fit, worst) or _describe_error(fit, worst)
    return ModelCheck(errors[worst], noises[worst], pattern)


def _estimate_noise(fit: MotorFit, problem: FitProblem, index: int) -> Floats:
    """Standard deviation of each line's noise that counts in a problem [rad/s]."""
    counts, step, cut = fit.rounding
    steps = counts**2 / 6.0 + (step**2 + cut**2 + PRINTED_STEP**2) / 12.0
    everything = [
        (fit.problem.answer(track, wheel, fit.wheels[index], fit.times), track)
        for track in problem.tracks
        for wheel in (problem.wheels[index],)
    ]
    squares, number = 0.0, 0
    for answer, track in everything:  # scatter where nothing happens
        rest = answer - track.speeds[:, problem.wheels[index]]
        newest = np.searchsorted(track.arrivals, track.stamps, side="right") - 1
        asked = track.commands[np.maximum(newest, 0), problem.wheels[index]]
        begin = np.searchsorted(track.stamps, track.stamps - CALM_TIME)
        calm = np.array([np.ptp(asked[i : k + 1]) < CALM_RANGE for k, i in enumerate(begin)])
        calm &= (track.stamps - track.stamps[0] > CALM_TIME) & (np.abs(answer) > PRINTED_STEP)
        jumps = np.diff(rest)[calm[1:] & calm[:-1]] ** 2
        usual = np.sort(jumps)[: math.ceil(0.95 * len(jumps))]
        squares, number = squares + float(usual.sum()), number + len(usual)
    if number >= FEWEST_CALM:
        steps = max(steps, squares / number / 2.0)
    blur = problem.dt + measure_line_rate(problem.tracks).jitter
    late = fit.times._replace(delay=fit.times.delay + blur)
    model = fit.wheels[index]
    moved = problem.residuals_of(index, model, late) - problem.residuals_of(
        index, model, fit.times
    )
    return np.sqrt(steps + moved**2)


def _describe_scale(fit: MotorFit, config: RobotConfig) -> str:
    """Say that gains are those of another unit, if they are."""
    gains = np.array([wheel.gain for wheel in fit.wheels])
    middle = float(np.median(gains))
    if LOWEST_RATIO <= middle <= HIGHEST_RATIO:
        far = np.flatnonzero((gains < LOWEST_RATIO) | (gains > HIGHEST_RATIO))
        if not len(far):
            return ""
        letter, gain = MOTORS[fit.problem.wheels[far[0]]], gains[far[0]]
        return f"wheel {letter} turns at {gain:.2f} of its command, unlike the others"
    size = f"{middle:.2f} times too large" if middle > 1.0 else f"{middle:.2f} of what it should be"
    return f"feedback is {size}: {likely_units(middle, config)}"


def _find_habit(fit: MotorFit, worst: int) -> str:
    """Name the habit that explains most of the error; empty where none explains half of it."""
    problem, times = fit.problem, fit.times

    def answer(index: int, own: Habits) -> Callable[[BoardTrack], Floats]:
        return lambda track: _answer_with_habits(
            track, problem, problem.wheels[index], fit, own
        )

    def rest_of(index: int, own: Habits) -> Floats:
        wheel = problem.wheels[index]
        return np.concatenate(
            [answer(index, own)(track) - track.speeds[:, wheel] for track in problem.tracks]
        )

    def refine(index: int, start: Habits, names: tuple[str, ...]) -> tuple[float, Habits]:
        places = [Habits._fields.index(name) for name in names]
        first = np.array([start[place] for place in places])

        def complete(x: Floats) -> Habits:
            moved = list(start)
            for place, value in zip(places, x.tolist(), strict=True):
                moved[place] = max(value, 0.0)
            return Habits(*moved)

        def cost(x: Floats) -> float:
            rest = rest_of(index, complete(x)) / scale
            return float(np.mean(np.sqrt(1.0 + rest * rest) - 1.0))

        around = np.tile(first, (len(first) + 1, 1))
        for row in range(len(first)):
            around[row + 1, row] += 0.2 * first[row] + 0.005
        found = optimize.minimize(
            cost,
            first,
            method="Nelder-Mead",
            options={"maxfev": EVALUATIONS, "initial_simplex": around},
        )
        return float(found.fun), complete(found.x)

    wheel = fit.wheels[worst]
    scale = max(0.05, float(np.median(_estimate_noise(fit, problem, worst))))
    plain = ("lag", "gain", "slowness", "deadband", "delay")
    delay = max(0.0, times.delay)
    starts = [
        Habits(wheel.lag, wheel.gain, wheel.slowness, wheel.deadband, delay),
        Habits(0.1, 1.0, 0.015, 0.1, max(0.01, delay)),
    ]
    base = min(refine(worst, start, plain) for start in starts)
    fastest = max(float(np.abs(t.speeds[:, problem.wheels[worst]]).max()) for t in problem.tracks)
    best_cost, best, habit = base[0], base[1], ""
    for name, values in HABIT_STARTS.items():
        for value, start in product(values, (base[1], starts[1])):
            other = start._replace(**{name: value * fastest if name == "top" else value})
            loss, own = refine(worst, other, (*plain, name))
            if loss < best_cost:
                best_cost, best, habit = loss, own, name
    if not habit or best_cost > (1.0 - EXPLAINED_SHARE) * base[0]:
        return ""
    if habit == "backward":
        found = [refine(k, best, (*plain, habit))[1].backward for k in range(len(fit.wheels))]
        parts = [
            f"wheel {MOTORS[problem.wheels[k]]} by {abs(1.0 - one):.0%}"
            for k, one in enumerate(found)
            if abs(1.0 - one) > 0.02
        ]
        return f"backward {'weaker' if best.backward < 1.0 else 'stronger'} than forward, " + (
            ", ".join(parts)
        )
    return {
        "top": f"saturates at {best.top:.1f} rad/s",
        "hold": f"holds for {best.hold:.2g} s at reversals",
        "overshoot": f"overshoots by {best.overshoot:.0%} after a step: the board runs its own "
        "control loop",
        "braking": f"slows down with another lag ({1e3 * best.lag * best.braking:.0f} ms) than it "
        f"speeds up ({1e3 * best.lag:.0f} ms)",
        "bend": f"gain falls with speed, by {best.bend:.0%} up to 10 rad/s",
        "stiction": f"starts at {best.deadband + best.stiction:.2f} rad/s, and turns on down to "
        f"{best.deadband:.2f}",
    }[habit]


def _answer_with_habits(
    track: BoardTrack, problem: FitProblem, wheel: int, fit: MotorFit, own: Habits
) -> Floats:
    """Speeds of a wheel with habits, at a track's stamps."""
    edges = track.loop_edges(problem.dt)
    stamps, commands = track.apply_timeout(fit.times.timeout)
    before, after, share = sample_commands(edges, stamps + own.delay, commands[:, wheel])
    speeds = simulate_habits(before + share * (after - before), problem.dt, own)
    ends = np.append(edges, edges[-1] + problem.dt)
    angles = np.append(0.0, np.cumsum(speeds) * problem.dt)
    turned = np.interp(track.stamps, ends, angles)
    window = fit.times.window
    return (turned - np.interp(track.stamps - window, ends, angles)) / window


def _describe_error(fit: MotorFit, worst: int) -> str:
    """Say where the error of a wheel is: by direction, speed, and time since a step."""
    wheel, parts = fit.problem.wheels[worst], []
    for track in fit.problem.tracks:
        answer = fit.problem.answer(track, wheel, fit.wheels[worst], fit.times)
        newest = np.searchsorted(track.arrivals, track.stamps, side="right") - 1
        asked = track.commands[np.maximum(newest, 0), wheel]
        jumps = track.stamps[1:][np.abs(np.diff(asked)) > STEP_JUMP]
        last = np.searchsorted(jumps, track.stamps, side="right") - 1
        since = np.where(last >= 0, track.stamps - jumps[np.maximum(last, 0)], np.inf)
        parts.append(np.stack((answer - track.speeds[:, wheel], answer, since)))
    rest, answer, since = np.concatenate(parts, axis=1)
    fast = np.abs(answer) > np.abs(answer).max() / 2.0
    places = {
        "forward": answer > 0.0,
        "backward": answer < 0.0,
        "at high speed": fast,
        "at low speed": ~fast,
        "soon after a step": since < STEP_TIME,
        "long after a step": since >= STEP_TIME,
    }
    sizes = {
        name: float(np.sqrt(np.mean(rest[where] ** 2)))
        for name, where in places.items()
        if where.sum() >= FEWEST_CALM
    }
    names = list(sizes)
    most = max(names, key=lambda name: sizes[name])
    least = min(names, key=lambda name: sizes[name])
    return (
        f"wheel {MOTORS[wheel]} is missed by {sizes[most]:.2f} rad/s {most}, by {sizes[least]:.2f} "
        f"{least}"
    )
