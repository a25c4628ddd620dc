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
from acsar_gym.recording.events import split_columns
from acsar_gym.recording.types import Episode, Floats, split_pieces
from acsar_gym.render.top_view import MOVER_COLOUR, TRUTH_COLOUR
from acsar_gym.safety.rules import Reason
from acsar_gym.worlds import World
from acsar_gym.worlds.crowd import NO_HIT, PERSON_HIT, ROBOT_HIT
from acsar_gym.worlds.pool import Pool
from acsar_gym.worlds.registry import parse_name
from acsar_gym.worlds.search import footprint_radius

ROOT = "run"  # entity of the run
TRAILS = ("path", "truth", "seen")  # entities of which all that was before the shown time is seen
TIMELINE = "time"  # time since the reset [s]
STEP_TICKS = 10  # ticks between two points of a path
MOVERS_RATE = 20.0  # how often a second movers are shown [Hz]
BURST_GAP = 1.0  # the same thing again within this time is in the same line of the log [s]
GOAL_RADIUS = 0.15  # of the ring around the goal [m]
CIRCLE = np.exp(1j * np.linspace(0.0, math.tau, 33))
BLUE = (60, 130, 240)
LINES = {"path": (BLUE, -2.0), "truth": (TRUTH_COLOUR, -1.0), "movers": (MOVER_COLOUR, -1.5)}
POINTS = {"scan": ((20, 190, 190), -2.5), "seen": ((120, 130, 140), -1.2)}
"""Colours of lines and points, and their radii, which Rerun takes as pixels if negative."""
FIXED = {
    "robot/footprint": BLUE,
    "goal": (26, 170, 100),
    "world/obstacles": (200, 90, 80),
    "world/route": (26, 143, 90),
}
"""Colours of lines that stay."""
PLOTS = {"measured": (217, 100, 10), "sent": BLUE, "asked": (150, 156, 164)}
SCALARS = {
    "command/linear/asked": "asked_linear",
    "command/linear/sent": "sent_linear",
    "command/linear/measured": "linear",
    "command/angular/asked": "asked_angular",
    "command/angular/sent": "sent_angular",
    "command/angular/measured": "angular",
    "lateness": "lateness",
    **{f"wheels/{WHEELS[number]}/measured": f"speed_{'abcd'[number]}" for number in range(4)},
}
"""Entities of plots, and the columns of ticks that they show."""
HITS = {ROBOT_HIT: "runs into a mover", PERSON_HIT: "a mover runs into it"}
REASONS: Mapping[int, tuple[str, str, tuple[int, int, int]]] = {
    Reason.NONE: ("sent as asked", "INFO", (70, 110, 80)),
    Reason.LIMITS: ("limits of speed or acceleration", "INFO", (242, 207, 102)),
    Reason.GEOFENCE: ("outside the geofence: held", "WARN", (155, 107, 211)),
    Reason.STALE_FEEDBACK: ("feedback too old: stopped", "WARN", (239, 138, 60)),
    Reason.EMERGENCY_STOP: ("emergency stop: held", "ERROR", (200, 30, 43)),
}
"""In words, level in the log, and colour."""
UNKNOWN_REASON = ("unknown", "INFO", (0, 0, 0))
Points = NDArray[np.complexfloating[Any, Any]]  # x + iy [m]
Line = tuple[float, str, str]
"""A line of the log: time [s], text, level."""


class EpisodeLogger:
    """Writes an episode into a recording of Rerun, part by part.

    Args:
        stream: The recording of Rerun.
        config: Robot configuration.
        header: Header of the recording.
    """

    def __init__(
        self, stream: rr.RecordingStream, config: RobotConfig, header: Mapping[str, Any]
    ) -> None:
        self._stream = stream
        self._config = config
        self._header = header
        self._has_begun = False
        self._ends: dict[str, Points] = {}
        self._last = {"reason": -1.0, "contact": 0.0, "hit": NO_HIT, "second": -1.0}

    def log(self, part: Episode) -> None:
        """Write a part, which has some of the rows of an episode's tables."""
        # Rerun keeps static data for all times, so they are sent once.
        if not self._has_begun:
            self._has_begun = True
            self._log_styles()
            self._log_surroundings(part)
        self._log_ticks(part)
        self._log_scans(part)
        self._log_movers(part)
        self.log_lines(sorted(self._list_lines(part)))

    def log_lines(self, lines: list[Line]) -> None:
        """Write lines of the log."""
        times = np.array([time for time, _, _ in lines], np.float64)
        texts = [escape_unprintable(text) for _, text, _ in lines]
        levels = [level for _, _, level in lines]
        self._send("log", times, rr.TextLog.columns(text=texts, level=levels))

    def _send(self, entity: str, times: Floats, columns: Any) -> None:
        if len(times):
            index = rr.TimeColumn(TIMELINE, duration=times)
            self._stream.send_columns(f"{ROOT}/{entity}", [index], columns)

    def _send_scalars(self, entity: str, times: Floats, values: Floats) -> None:
        # NaN is what isn't known, such as lateness in simulation.
        is_known = np.isfinite(values)
        self._send(entity, times[is_known], rr.Scalars.columns(scalars=values[is_known]))

    def _set(self, entity: str, archetype: Any) -> None:
        """Set what doesn't change."""
        self._stream.log(f"{ROOT}/{entity}", archetype, static=True)

    def _draw(self, entity: str, lines: list[Points]) -> None:
        """Draw lines of points x + iy that stay."""
        self._set(entity, rr.LineStrips3D(list(map(_lift, lines)), colors=FIXED[entity]))

    def _log_styles(self) -> None:
        """Set colours, and the names of plots."""
        for archetype, styles in ((rr.LineStrips3D, LINES), (rr.Points3D, POINTS)):
            for entity, (colour, radius) in styles.items():
                self._set(entity, archetype.from_fields(colors=[colour], radii=[radius]))
        for entity in (*SCALARS, *(f"wheels/{wheel}/sent" for wheel in WHEELS)):
            kind = entity.rpartition("/")[2]
            self._set(entity, rr.SeriesLines(colors=PLOTS.get(kind), names=kind))
        words, _, colours = zip(*REASONS.values(), strict=True)
        self._set("safety", rr.StateConfiguration(values=words, labels=words, colors=colours))

    def _log_surroundings(self, part: Episode) -> None:
        """Draw the robot's footprint, the goal and the world, and note that it begins."""
        # Closed, with a line to the front that shows the heading.
        corners = np.array([*self._config.outline, self._config.outline[0]]) @ (1.0, 1j)
        front = np.array([0.0, corners.real.max()], np.complex128)
        self._draw("robot/footprint", [corners, front])
        goal = read_numbers(part, "goal", 2)
        if goal is not None:
            self._draw("goal", [complex(*goal) + GOAL_RADIUS * CIRCLE])

        world = find_world(self._header, self._config, part)
        if world is not None:
            # Worlds are known in their own frame, drives in that of the odometry.
            rings = [x + 1j * y + radius * CIRCLE for x, y, radius in world.circles]
            walls = world.segments.reshape(-1, 2, 2) @ (1.0, 1j)
            self._draw("world/obstacles", [_to_odometry(part, line) for line in (*rings, *walls)])
            if world.path is not None:
                self._draw("world/route", [_to_odometry(part, world.path @ (1.0, 1j))])

        named = [f"{name} {part.info[name]}" for name in ("seed", "world") if name in part.info]
        self.log_lines([(0.0, f"begins: {', '.join(named)}" if named else "begins", "INFO")])

    def _log_ticks(self, part: Episode) -> None:
        columns = split_columns(part.tables["ticks"])
        columns["lateness"] = columns["lateness"] * 1e3  # [ms]
        times = columns["stamp"] - part.start
        for entity, name in SCALARS.items():
            self._send_scalars(entity, times, columns[name])
        # What was sent is decoded from the bytes, as the board did.
        stamps, speeds = part.wire.commands(self._config)
        for wheel, sent in zip(WHEELS, speeds.T, strict=True):
            self._send_scalars(f"wheels/{wheel}/sent", stamps - part.start, sent)

        # Pose and paths.
        points = columns["x"] + 1j * columns["y"]
        turns = np.zeros((len(times), 4))
        turns[:, 2] = np.sin(columns["theta"] / 2.0)
        turns[:, 3] = np.cos(columns["theta"] / 2.0)
        place = rr.Transform3D.columns(translation=_lift(points), quaternion=turns)
        self._send("robot", times, place)
        self._log_path("path", times, points)
        # Hardware has no truth.
        exchanges = part.exchanges[np.isfinite(part.exchanges["contact"])]
        true_points = _to_odometry(part, exchanges["pose"][:, :2] @ (1.0, 1j))
        self._log_path("truth", exchanges["stamp"] - part.start, true_points)

        # The safety layer holds its state until it changes.
        changes = np.flatnonzero(self._changes("reason", part.reasons))
        reasons = [REASONS.get(number, UNKNOWN_REASON) for number in part.reasons[changes].tolist()]
        words = [word for word, _, _ in reasons]
        self._send("safety", times[changes], rr.StateChange.columns(state=words))
        lines = zip(times[changes].tolist(), reasons, strict=True)
        self.log_lines([(time, word, kind) for time, (word, kind, _) in lines if kind != "INFO"])

    def _log_path(self, entity: str, times: Floats, points: Points) -> None:
        """Write a path as short pieces, each at its own time, after the part before."""
        if not len(points):
            return
        # The last point of the part is where the next part goes on.
        rows = np.unique([*range(0, len(points), STEP_TICKS), len(points) - 1])
        corners = np.concatenate([self._ends.get(entity, points[:1]), points[rows]])
        self._ends[entity] = corners[-1:]
        pieces = _lift(np.stack([corners[:-1], corners[1:]], axis=1))
        self._send(entity, times[rows], rr.LineStrips3D.columns(strips=list(pieces)))

    def _log_scans(self, part: Episode) -> None:
        """Write the points of each scan, and once a second those that stay."""
        config = self._config
        spec = ray_spec(config)
        stamps, ranges, _ = part.scans
        # For a scan of another LiDAR the directions of the rays aren't known.
        if ranges.shape[1] != spec.rays or not len(part.stamps):
            return
        # Scans come between ticks.
        x, y = (np.interp(stamps, part.stamps, column) for column in part.poses.T[:2])
        # Across pi, interpolation of a wrapped heading would turn through 0.
        headings = np.interp(stamps, part.stamps, np.unwrap(part.poses[:, 2]))
        mount = complex(config.lidar_x_offset, config.lidar_y_offset)
        rays = mount + ranges * np.exp(1j * spec.angles())
        hits = (x + 1j * y)[:, None] + rays * np.exp(1j * headings)[:, None]
        is_hit = np.isfinite(ranges) & (ranges < config.lidar.max_range) & (ranges > 0.0)

        # Points of one scan a second stay.
        times = stamps - part.start
        is_new = self._changes("second", np.floor(times)) != 0.0
        for entity, rows in (("scan", is_new | True), ("seen", is_new)):
            points = rr.Points3D.columns(positions=_lift(hits[rows][is_hit[rows]]))
            self._send(entity, times[rows], points.partition(is_hit[rows].sum(axis=1)))

    def _log_movers(self, part: Episode) -> None:
        """Write what moves, as rings, with lines to where each will be in a second."""
        movers = part.movers
        # Movers are recorded in each period, more often than a viewer draws.
        rows = movers.exchanges % max(1, round(self._config.control_rate / MOVERS_RATE)) == 0
        strips: list[Floats] = []
        for x, y, x_rate, y_rate, radius in movers.states[rows].transpose(0, 2, 1)[..., None]:
            middle = x + 1j * y
            ahead = np.hstack([middle, middle + x_rate + 1j * y_rate])
            lines = (*(middle + radius * CIRCLE), *ahead)
            strips += [_lift(_to_odometry(part, line)) for line in lines]
        counts = [2 * movers.states.shape[1]] * int(rows.sum())
        columns = rr.LineStrips3D.columns(strips=strips).partition(counts)
        self._send("movers", movers.stamps[rows] - part.start, columns)

    def _changes(self, name: str, values: NDArray[Any]) -> Floats:
        """Changes from row to row, (n,), also from the part before. 0 for the first row of all."""
        # NaN differs from itself, and would count as a change in every row.
        values = np.nan_to_num(values.astype(np.float64))
        changes: Floats = np.diff(values, prepend=self._last.get(name, values[:1].sum()))
        if len(values):
            self._last[name] = float(values[-1])
        return changes

    def _list_lines(self, part: Episode) -> Iterator[Line]:
        """What happened in a part."""
        ticks = part.tables["ticks"]
        stamps = part.stamps
        late = np.where(part.lateness > self._config.late_tick, part.lateness, 0.0)
        # A running number, of which the log shows the increase.
        refused = self._changes("refused", ticks["refused"])
        lost = self._changes("exchange", ticks["exchange"]) - 1.0
        touched = self._changes("contact", part.exchanges["contact"])
        for text, level, times, amounts in (
            ("late: {count:,} ticks, at worst by {worst:.1f} ms", "WARN", stamps, 1e3 * late),
            ("{total:,.0f} parts of the input were refused", "WARN", stamps, refused),
            ("{total:,.0f} control periods aren't recorded", "WARN", stamps, lost),
            ("touches an obstacle", "ERROR", part.exchanges["stamp"], touched),
        ):
            rows = np.flatnonzero(amounts > 0.0)
            pauses = np.flatnonzero(np.diff(times[rows]) > BURST_GAP) + 1
            for burst in filter(len, np.split(rows, pauses)):
                total = amounts[burst].sum()
                words = text.format(count=len(burst), total=total, worst=amounts[burst].max())
                yield float(times[burst[0]]) - part.start, words, level

        hits = part.movers.hits
        for row in np.flatnonzero(self._changes("hit", hits)):
            text = HITS.get(float(hits[row]), "a contact")
            yield float(part.movers.stamps[row]) - part.start, text, "ERROR"
        faults = part.tables["faults"]["stamp"].tolist()
        for stamp, fault in zip(faults, split_pieces(part.tables, "faults"), strict=True):
            yield stamp - part.start, fault.decode(errors="replace"), "ERROR"
        for step in part.tables["steps"][-1:]:
            if step["terminated"] or step["truncated"]:
                failure = "failed" if step["terminated"] else "cut short by a fault"
                text = f"ends: {'solved' if step['success'] else failure}, {step['step']:,} steps"
                level = "INFO" if step["success"] else "WARN"
                yield float(step["stamp"]) - part.start, text, level


def _lift(points: Points) -> Floats:
    """Points x + iy as points on the ground, (..., 3)."""
    return np.stack([points.real, points.imag, np.zeros(points.shape)], axis=-1)


def read_numbers(part: Episode, name: str, count: int) -> tuple[float, ...] | None:
    """Return some numbers of an episode's `info`. None if they aren't there."""
    try:
        numbers = tuple(map(float, part.info[name]))
    except (KeyError, TypeError, ValueError, OverflowError):
        return None
    return numbers if len(numbers) == count and np.isfinite(numbers).all() else None


def _to_odometry(part: Episode, points: Points) -> Points:
    """Points of the world's frame in that of the odometry, which begins at the start."""
    x, y, theta = read_numbers(part, "start", 3) or (0.0, 0.0, 0.0)
    moved: Points = (points - complex(x, y)) * np.exp(-1j * theta)
    return moved


def find_world(header: Mapping[str, Any], config: RobotConfig, part: Episode) -> World | None:
    """Return the world of a simulated episode. None if it isn't known.

    Only worlds of this package's own generators are made again: a recording may name any module.
    """
    env = header.get("about", {}).get("env")
    options = env.get("kwargs") if isinstance(env, dict) else None
    if not isinstance(options, dict):
        return None
    source: Any = options.get("worlds")
    names = [parse_name(str(item)) for item in (source if isinstance(source, list) else [source])]
    if not all(name and not name.module for name in names):
        return None
    # The file may name a world that this version doesn't have: then none is drawn.
    key: Any = part.info.get("world")
    try:
        return Pool.of(source, options.get("difficulty"), footprint_radius(config))[key]
    except (AcsarError, TypeError, ValueError):
        return None


def make_blueprint(part: Episode, *, is_live: bool) -> rrb.Blueprint:
    """Lay the views out: from above, wheels, command and why, log."""
    # Trails show all that was before the time of the cursor.
    past = rrb.VisibleTimeRanges(
        timeline=TIMELINE,
        start=rrb.TimeRangeBoundary.infinite(),
        end=rrb.TimeRangeBoundary.cursor_relative(),
    )
    # The camera looks down on start and goal.
    x, y = np.divide(read_numbers(part, "goal", 2) or (0.0, 0.0), 2.0).tolist()
    height = 2.4 * max(math.hypot(x, y), 1.5) + 2.0
    # Seen from straight above no direction would be up, so the eye is 1 cm off.
    eye = rrb.EyeControls3D(position=(x, y - 0.01, height), look_target=(x, y, 0.0))
    above = rrb.Spatial3DView(
        name="From above",
        contents="/**",
        overrides={f"{ROOT}/{name}": [past] for name in TRAILS},
        eye_controls=eye,
    )

    units = {f"wheels/{wheel}": "rad/s" for wheel in sorted(WHEELS)}
    units |= {"command/linear": "m/s", "command/angular": "rad/s", "lateness": "ms"}
    plots = [
        rrb.TimeSeriesView(name=f"{entity} [{unit}]", contents=f"/{ROOT}/{entity}/**")
        for entity, unit in units.items()
    ]
    why = rrb.StateTimelineView(name="Safety layer", contents=f"/{ROOT}/safety")
    log = rrb.TextLogView(name="Log", contents=f"/{ROOT}/log")

    return rrb.Blueprint(
        rrb.Horizontal(
            rrb.Vertical(above, log, row_shares=[3, 1]), rrb.Grid(*plots, why, grid_columns=2)
        ),
        rrb.TimePanel(
            timeline=TIMELINE,
            play_state="following" if is_live else "playing",
            state="collapsed",
        ),
        rrb.SelectionPanel(state="hidden"),
    )
