"""What an episode is in Rerun: entities, their times since the reset, and how they are laid out."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from numpy.typing import NDArray

from acsar_gym.config import RobotConfig
from acsar_gym.errors import AcsarError, escape_unprintable
from acsar_gym.lidar.scan import ray_spec
from acsar_gym.protocol import WHEELS
from acsar_gym.recording.types import Floats
from acsar_gym.render.top_view import MOVER_COLOUR, TRUTH_COLOUR
from acsar_gym.safety.rules import Reason
from acsar_gym.tools.view.parts import Part
from acsar_gym.worlds import World
from acsar_gym.worlds.crowd import NO_HIT, PERSON_HIT, ROBOT_HIT
from acsar_gym.worlds.pool import Pool
from acsar_gym.worlds.registry import parse_name
from acsar_gym.worlds.search import footprint_radius

APPLICATION = "acsar_gym"
ROOT = "run"
"""Entity of the run."""
TRAILS = ("path", "truth", "seen")
"""Entities of which all that was before the shown time is seen."""
TIMELINE = "time"
"""Time since the reset [s]."""
BURST_GAP = 1.0
"""The same thing again within this time is in the same line of the log [s]."""
STEP_LENGTH = 0.01
"""Length of the pieces of a path [m]."""
MOVERS_PERIOD = 0.05
"""Time between two places of a mover [s]."""
SEEN_CELL = 0.05
"""What a LiDAR has seen is remembered once for each square of this side [m]."""
CIRCLE = np.stack([f(np.linspace(0.0, math.tau, 33)) for f in (np.cos, np.sin)], axis=1)
COLOURS = {
    "measured": (217, 100, 10),
    "sent": (60, 130, 240),
    "asked": (150, 156, 164),
    "path": (60, 130, 240),
    "truth": TRUTH_COLOUR,
    "scan": (20, 190, 190),
    "seen": (120, 130, 140),
    "obstacles": (200, 90, 80),
    "route": (26, 143, 90),
    "goal": (26, 170, 100),
    "movers": MOVER_COLOUR,
}
HITS = {ROBOT_HIT: "runs into a mover", PERSON_HIT: "a mover runs into it"}
"""In words for the log."""
REASONS = {
    Reason.NONE: ("sent as asked", "INFO", (70, 110, 80)),
    Reason.LIMITS: ("limits of speed or acceleration", "INFO", (242, 207, 102)),
    Reason.GEOFENCE: ("outside the geofence: held", "WARN", (155, 107, 211)),
    Reason.STALE_FEEDBACK: ("feedback too old: stopped", "WARN", (239, 138, 60)),
    Reason.EMERGENCY_STOP: ("emergency stop: held", "ERROR", (200, 30, 43)),
}
"""In words, level in the log, and colour."""


class EpisodeLogger:
    """Writes an episode into a recording of Rerun.

    Args:
        stream: The recording of Rerun.
        config: The robot.
        header: Header of the recording.
    """

    def __init__(
        self, stream: rr.RecordingStream, config: RobotConfig, header: Mapping[str, Any]
    ) -> None:
        self._stream = stream
        self._config = config
        self._header = header
        self._begun = False
        self._ends: dict[str, Floats] = {}
        self._last = {"reason": -1.0, "contact": 0.0, "hit": NO_HIT, "mark": -1.0}
        self._seen = np.zeros(0, np.complex128)

    def log(self, part: Part) -> None:
        """Write a part."""
        if not self._begun:
            self._begun = True
            self._log_beginning(part)
        self._log_ticks(part)
        self._log_scans(part)
        self._log_movers(part)
        self._send_text(sorted(self._list_lines(part)))

    def log_text(self, time: float, text: str, level: str = "INFO") -> None:
        """Write a line of the log."""
        self._send_text([(time, text, level)])

    def _send(self, entity: str, times: Floats, columns: Any) -> None:
        if len(times):
            index = rr.TimeColumn(TIMELINE, duration=times)
            self._stream.send_columns(f"{ROOT}/{entity}", [index], columns)

    def _send_static(self, entity: str, archetype: Any) -> None:
        self._stream.log(f"{ROOT}/{entity}", archetype, static=True)

    def _send_text(self, lines: list[tuple[float, str, str]]) -> None:
        if lines:
            times, texts, levels = zip(*lines, strict=True)
            columns = rr.TextLog.columns(text=[escape_unprintable(t) for t in texts], level=levels)
            self._send("log", np.array(times), columns)

    def _log_beginning(self, part: Part) -> None:
        """What doesn't change: robot, goal, world, and what lines are called."""
        config, body = self._config, COLOURS["path"]
        corners = np.array([*config.outline, config.outline[0]])
        front = np.array([(0.0, 0.0), (float(corners[:, 0].max()), 0.0)])
        self._send_static("robot/footprint", rr.LineStrips3D(_lift([corners, front]), colors=body))
        plots = [f"command/{name}" for name in ("linear", "angular")]
        plots += [f"wheels/{wheel}" for wheel in WHEELS]
        for kind in ("asked", "sent", "measured"):
            line = rr.SeriesLines(colors=COLOURS[kind], names=kind)
            for plot in plots:
                self._send_static(f"{plot}/{kind}", line)
        words, _, colours = zip(*REASONS.values(), strict=True)
        states = rr.StateConfiguration(values=words, labels=words, colors=colours)
        self._send_static("safety", states)
        self._send_static("lateness", rr.SeriesLines(names="lateness [ms]"))
        if (goal := part.numbers("goal", 2)) is not None:
            ring = np.array(goal) + 0.15 * CIRCLE
            self._send_static("goal", rr.LineStrips3D(_lift([ring]), colors=COLOURS["goal"]))
        world = find_world(self._header, config, part)
        if world is not None:
            rings = [circle[:2] + circle[2] * CIRCLE for circle in world.circles]
            shapes = [*rings, *world.segments.reshape(-1, 2, 2)]
            lines = _lift([to_odometry_points(part.start, shape) for shape in shapes])
            walls = rr.LineStrips3D(lines, colors=COLOURS["obstacles"])
            self._send_static("world/obstacles", walls)
            if world.path is not None:
                path = _lift([to_odometry_points(part.start, world.path)])
                route = rr.LineStrips3D(path, colors=COLOURS["route"])
                self._send_static("world/route", route)
        named = [f"{name} {part.info[name]}" for name in ("seed", "world") if name in part.info]
        self.log_text(0.0, f"begins: {', '.join(named)}" if named else "begins")

    def _log_ticks(self, part: Part) -> None:
        ticks = part.ticks
        poses = ticks["pose"]
        times, half = ticks["stamp"], poses[:, 2] / 2.0
        zeros = np.zeros(len(times))
        turn = np.stack([zeros, zeros, np.sin(half), np.cos(half)], axis=1)
        place = np.column_stack([poses[:, :2], zeros])
        self._send("robot", times, rr.Transform3D.columns(translation=place, quaternion=turn))
        self._log_path("path", times, poses[:, :2])
        truth = part.exchanges[np.isfinite(part.exchanges["contact"])]
        true_points = to_odometry_points(part.start, truth["pose"][:, :2])
        self._log_path("truth", truth["stamp"], true_points)
        for axis, name in enumerate(("linear", "angular")):
            for kind, column in (("asked", "asked"), ("sent", "sent"), ("measured", "twist")):
                self._send_scalars(f"command/{name}/{kind}", times, ticks[column][:, axis])
        for number, wheel in enumerate(WHEELS):
            self._send_scalars(f"wheels/{wheel}/measured", times, ticks["speeds"][:, number])
            sent = part.sent[:, 1 + number]
            self._send_scalars(f"wheels/{wheel}/sent", part.sent[:, 0], sent)
        self._send_scalars("lateness", times, ticks["lateness"] * 1e3)
        changes = np.flatnonzero(self._changes("reason", ticks["reason"]))
        reasons = [_describe_reason(ticks["reason"][row]) for row in changes]
        words = [word for word, _, _ in reasons]
        self._send("safety", times[changes], rr.StateChange.columns(state=words))
        for row, (word, level, _) in zip(changes, reasons, strict=True):
            if level != "INFO":
                self.log_text(float(times[row]), word, level)

    def _send_scalars(self, entity: str, times: Floats, values: Floats) -> None:
        finite = np.isfinite(values)
        self._send(entity, times[finite], rr.Scalars.columns(scalars=values[finite]))

    def _log_path(self, entity: str, times: Floats, points: Floats) -> None:
        """A path as short pieces, each at its own time."""
        before = self._ends.get(entity)
        if before is not None:
            points = np.concatenate([before, points])
            times = np.concatenate([times[:1], times])
        way = np.hypot(*np.diff(points, axis=0).T).cumsum() if len(points) > 1 else np.zeros(0)
        steps = np.diff(np.floor(way / STEP_LENGTH), prepend=0.0)
        chosen = np.concatenate([[0], 1 + np.flatnonzero(steps)])[: len(points)]
        pieces = np.stack([points[chosen[:-1]], points[chosen[1:]]], axis=1)
        colour = [COLOURS[entity]] * len(pieces)
        width = np.full(len(pieces), -2.0 if entity == "path" else -1.0)
        columns = rr.LineStrips3D.columns(strips=_lift(pieces), colors=colour, radii=width)
        self._send(entity, times[chosen[1:]], columns)
        if len(chosen):
            self._ends[entity] = points[chosen[-1:]]

    def _log_scans(self, part: Part) -> None:
        """Points of each scan, and those of them that are new: what was seen so far."""
        spec, ticks, config = ray_spec(self._config), part.ticks, self._config
        if part.ranges.shape[1] != spec.rays or not len(ticks["stamp"]):
            return
        angles, stamps = spec.angles(), part.scan_times
        x, y, theta = ticks["pose"].T
        x, y = (np.interp(stamps, ticks["stamp"], column) for column in (x, y))
        headings = np.interp(stamps, ticks["stamp"], np.unwrap(theta))
        points, new_points = [], []
        for row, ranges in enumerate(part.ranges):
            hit = np.isfinite(ranges) & (ranges < config.lidar.max_range) & (ranges > 0.0)
            mount = complex(config.lidar_x_offset, config.lidar_y_offset)
            rays = mount + ranges[hit] * np.exp(1j * angles[hit])
            hits = complex(x[row], y[row]) + rays * np.exp(1j * headings[row])
            cells = np.unique(np.round(hits / SEEN_CELL)) * SEEN_CELL
            new = np.setdiff1d(cells, self._seen)
            self._seen = np.union1d(self._seen, new)
            points.append(hits)
            new_points.append(new)
        self._send_points("scan", stamps, points, 2.5)
        self._send_points("seen", stamps, new_points, 1.2)

    def _log_movers(self, part: Part) -> None:
        """What moves, as rings, with lines to where each will be in a second."""
        movers = part.movers
        marks = np.floor(movers.stamps / MOVERS_PERIOD + 1e-6)
        chosen = np.flatnonzero(self._changes("mark", marks))
        strips, counts = [], []
        for row in chosen:
            x, y, vx, vy, radius = movers.states[row].T[:, :, None]
            middle, ahead = np.stack([x, y], axis=2), np.stack([x + vx, y + vy], axis=2)
            shapes = [*(middle + radius[:, :, None] * CIRCLE), *np.hstack([middle, ahead])]
            strips += _lift([to_odometry_points(part.start, shape) for shape in shapes])
            counts.append(len(shapes))
        colours = [COLOURS["movers"]] * len(strips)
        columns = rr.LineStrips3D.columns(strips=strips, colors=colours)
        self._send("movers", movers.stamps[chosen], columns.partition(counts))

    def _send_points(
        self, entity: str, times: Floats, rows: list[NDArray[np.complex128]], size: float
    ) -> None:
        """Points as complex numbers, of so many pixels: Rerun takes negative radii as such."""
        points = np.concatenate([*rows, np.zeros(0, np.complex128)])
        columns = rr.Points3D.columns(
            positions=np.stack([points.real, points.imag, np.zeros(len(points))], axis=1),
            colors=[COLOURS[entity]] * len(points),
            radii=np.full(len(points), -size),
        )
        self._send(entity, times, columns.partition([len(row) for row in rows]))

    def _changes(self, name: str, values: Floats) -> Floats:
        """Changes from row to row, (n,), also from the block before; 0 for the first row of all."""
        values = np.nan_to_num(values)
        before = self._last.get(name, values[:1].sum())
        if len(values):
            self._last[name] = float(values[-1])
        changes: Floats = np.diff(values, prepend=before)
        return changes

    def _list_lines(self, part: Part) -> Iterator[tuple[float, str, str]]:
        """What happened in a part: time, text and level."""
        ticks = part.ticks
        times, lateness = ticks["stamp"], ticks["lateness"]
        for burst in _group_bursts(times, lateness > self._config.late_tick):
            count, worst = len(burst), float(lateness[burst].max()) * 1e3
            ticks_late = f"{count:,} tick{'s' * (count != 1)}"
            yield float(times[burst[0]]), f"late: {ticks_late}, at worst by {worst:.1f} ms", "WARN"
        for column, usual, text in (
            ("refused", 0.0, "parts of the input were refused"),
            ("exchange", 1.0, "control periods aren't recorded"),
        ):
            more = self._changes(column, ticks[column]) - usual
            for burst in _group_bursts(times, more > 0.0):
                yield float(times[burst[0]]), f"{more[burst].sum():,.0f} {text}", "WARN"
        exchanges = part.exchanges
        touched = self._changes("contact", exchanges["contact"]) > 0.0
        for burst in _group_bursts(exchanges["stamp"], touched):
            yield float(exchanges["stamp"][burst[0]]), "touches an obstacle", "ERROR"
        movers = part.movers
        for row in np.flatnonzero(self._changes("hit", movers.hits)):
            yield float(movers.stamps[row]), HITS.get(float(movers.hits[row]), "a contact"), "ERROR"
        for time, text in part.faults:
            yield time, text, "ERROR"
        if len(part.steps):
            step = part.steps[-1]
            if step["terminated"] or step["truncated"]:
                how = "failed" if step["terminated"] else "cut short by a fault"
                how = "solved" if step["success"] else how
                level = "INFO" if step["success"] else "WARN"
                yield float(step["stamp"]), f"ends: {how}, {step['step']:,} steps", level


def _lift(lines: Any) -> list[Floats]:
    """Lines of points (n, 2) as lines on the ground."""
    return [np.column_stack([line, np.zeros(len(line))]) for line in lines]


def to_odometry_points(start: tuple[float, float, float], points: Floats) -> Floats:
    """Points (n, 2) of the world's frame in that of the odometry, which begins at `start`."""
    x, y, theta = start
    turn = np.array([[math.cos(theta), -math.sin(theta)], [math.sin(theta), math.cos(theta)]])
    moved: Floats = (points - (x, y)) @ turn
    return moved


def _group_bursts(times: Floats, happened: NDArray[np.bool_]) -> list[NDArray[np.intp]]:
    """Rows at which something happened, in groups less than BURST_GAP apart."""
    rows = np.flatnonzero(happened)
    if not len(rows):
        return []
    return np.split(rows, np.flatnonzero(np.diff(times[rows]) > BURST_GAP) + 1)


def _describe_reason(number: float) -> tuple[str, str, tuple[int, int, int]]:
    """Words, level and colour of a reason of the safety layer."""
    reason = int(np.nan_to_num(number, nan=-1.0))
    return REASONS.get(reason, ("unknown", "INFO", (0, 0, 0)))  # type: ignore[call-overload, no-any-return]


def find_world(header: Mapping[str, Any], config: RobotConfig, part: Part) -> World | None:
    """Return the world of a simulated episode; None where it isn't known.

    Only worlds of this package's own generators are made again: a recording may name any module.
    """
    env = header.get("about", {}).get("env")
    options = env.get("kwargs") if isinstance(env, dict) else None
    if not isinstance(options, dict):
        return None
    source: Any = options.get("worlds")
    key: Any = part.info.get("world")
    names = [parse_name(str(item)) for item in (source if isinstance(source, list) else [source])]
    if not part.is_simulated or not all(name and not name.module for name in names):
        return None
    try:
        level = options.get("difficulty")
        return Pool.of(source, level, footprint_radius(config))[key]
    except (AcsarError, TypeError, ValueError):
        return None


def make_blueprint(part: Part) -> rrb.Blueprint:
    """Lay the views out: from above, wheels, command and why, log."""
    past = rrb.VisibleTimeRanges(
        timeline=TIMELINE,
        start=rrb.TimeRangeBoundary.infinite(),
        end=rrb.TimeRangeBoundary.cursor_relative(),
    )
    x, y = part.numbers("goal", 2) or (0.0, 0.0)
    height = 1.2 * max(math.hypot(x, y), 3.0) + 2.0
    above = rrb.Spatial3DView(
        name="From above",
        contents="/**",
        overrides={f"{ROOT}/{name}": [past] for name in TRAILS},
        eye_controls=rrb.EyeControls3D(
            position=(x / 2.0, y / 2.0 - 0.01, height), look_target=(x / 2.0, y / 2.0, 0.0)
        ),
    )

    def plot(name: str, entity: str, *, legend: bool = False) -> rrb.TimeSeriesView:
        return rrb.TimeSeriesView(
            name=name,
            contents=f"/{ROOT}/{entity}/**",
            plot_legend=rrb.PlotLegend(visible=legend),
        )

    wheels = [
        plot(f"{wheel.replace('_', ' ')} [rad/s]", f"wheels/{wheel}", legend=wheel == "front_left")
        for wheel in ("front_left", "front_right", "rear_left", "rear_right")
    ]
    twist = plot("linear [m/s]", "command/linear"), plot("angular [rad/s]", "command/angular")
    why = [rrb.StateTimelineView(name="Safety layer", contents="/run/safety")]
    lateness = plot("Lateness [ms]", "lateness")
    log = rrb.TextLogView(name="Log", contents=f"/{ROOT}/log")
    return rrb.Blueprint(
        rrb.Horizontal(
            rrb.Vertical(above, log, row_shares=[3, 1]),
            rrb.Vertical(
                rrb.Grid(*wheels, grid_columns=2),
                rrb.Horizontal(*twist),
                rrb.Horizontal(*why, lateness),
                row_shares=[5, 3, 2],
            ),
        ),
        rrb.TimePanel(timeline=TIMELINE, play_state="playing", state="collapsed"),
        rrb.SelectionPanel(state="hidden"),
        rrb.BlueprintPanel(state="expanded" if part.episode else "collapsed"),
    )
