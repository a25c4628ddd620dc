"""What the page shows of an episode at a time: plotly figures, and figures in words."""

from __future__ import annotations

import base64
import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from acsar_gym.config import RobotConfig
from acsar_gym.errors import AcsarError
from acsar_gym.recording.encoder import LATE_TICK
from acsar_gym.safety.rules import Reason
from acsar_gym.sensors.lidar import ray_spec
from acsar_gym.tools.view.tail import (
    TICK_PLACES,
    Floats,
    GrowingEpisode,
    thin_evenly,
    thin_keeping_peaks,
)
from acsar_gym.worlds import World, registry
from acsar_gym.worlds.pool import Pool
from acsar_gym.worlds.search import footprint_radius
from acsar_gym.worlds.world import to_odometry

INK_COLOUR, MUTED_COLOUR, GRID_COLOUR, PAPER_COLOUR = "#1c1e21", "#62676e", "#ececee", "#ffffff"
ASKED_COLOUR, SENT_COLOUR, MEASURED_COLOUR = "#868c94", "#1f5fd6", "#d9640a"
GOAL_COLOUR, SCAN_COLOUR, SEEN_COLOUR, WALL_COLOUR, TRUTH_COLOUR = (
    "#1a8f5a",
    "#0f8b8d",
    "#c3ccd4",
    "#6b7280",
    "#9b6bd3",
)
REASON_COLOURS = ("#dfe9e2", "#f2cf66", "#9b6bd3", "#ef8a3c", "#c81e2b")
"""Of each `safety.rules.Reason`."""
SPECK_LENGTH = 0.001
"""Length of the pieces of a line that are points [m]."""
PAGE_FONT = {"family": "system-ui, 'Segoe UI', Roboto, 'Helvetica Neue', Arial, sans-serif"}

Figure = dict[str, Any]


def pack_numbers(values: NDArray[Any]) -> dict[str, str]:
    """Return an array as plotly.js reads it fastest: 32-bit floats in base64."""
    data = np.ascontiguousarray(values, "<f4").tobytes()
    return {"dtype": "f4", "bdata": base64.b64encode(data).decode()}


def make_layout(revision: str, **more: Any) -> Figure:
    """Return a plotly layout.

    Args:
        revision: what zoom and pan belong to; they are kept for as long as it is the same.
        **more: of the layout.
    """
    return {
        "font": PAGE_FONT | {"size": 12, "color": INK_COLOUR},
        "paper_bgcolor": PAPER_COLOUR,
        "plot_bgcolor": PAPER_COLOUR,
        "showlegend": False,
        "hovermode": False,
        "uirevision": revision,
        "margin": {"l": 48, "r": 12, "t": 12, "b": 36},
        **more,
    }


def make_axis(title: str, **more: Any) -> Figure:
    """Return a plotly axis."""
    return {
        "title": {"text": title, "standoff": 6, "font": {"size": 12, "color": MUTED_COLOUR}},
        "gridcolor": GRID_COLOUR,
        "zeroline": False,
        "linecolor": GRID_COLOUR,
        "tickfont": {"size": 11, "color": MUTED_COLOUR},
        **more,
    }


def draw_line(x: NDArray[Any], y: NDArray[Any], colour: str, **more: Any) -> Figure:
    """Return a plotly line, 1.6 px wide unless `more` says otherwise."""
    style = {"color": colour, "width": 1.6} | more.pop("line", {})
    return {
        "type": "scatter",
        "mode": "lines",
        "x": pack_numbers(x),
        "y": pack_numbers(y),
        "line": style,
        **more,
    }


def draw_specks(points: NDArray[Any], colour: str, size: float, **more: Any) -> Figure:
    """Return many points (n, 2) as one plotly line, which a browser draws much faster than markers.

    The line is in pieces of almost no length, to which dashboard.css gives round ends.
    """
    gap = np.full(len(points), np.nan)
    x = np.stack([points[:, 0], points[:, 0] + SPECK_LENGTH, gap], axis=1).ravel()
    y = np.stack([points[:, 1], points[:, 1], gap], axis=1).ravel()
    return draw_line(x, y, colour, line={"width": size, "simplify": False}, **more)


def draw_markers(points: NDArray[Any], colour: str, size: float, **more: Any) -> Figure:
    """Return plotly markers at points (n, 2)."""
    return {
        "type": "scatter",
        "mode": "markers",
        "x": pack_numbers(points[:, 0]),
        "y": pack_numbers(points[:, 1]),
        "marker": {"color": colour, "size": size, "line": {"width": 0}},
        **more,
    }


NO_VALUE = "\N{EN DASH}"
REASON_WORDS = {
    Reason.NONE: "sent as asked",
    Reason.LIMITS: "limits of speed or acceleration",
    Reason.GEOFENCE: "outside the geofence: held",
    Reason.STALE_FEEDBACK: "feedback too old: stopped",
    Reason.EMERGENCY_STOP: "emergency stop: held",
}


def read_values(episode: GrowingEpisode, time: float) -> dict[str, str]:
    """Return the texts of the page's tiles.

    Args:
        episode: what is shown.
        time: since its reset [s].

    Returns:
        `time`; `linear` and `angular` as asked, sent and measured, with `_asked`, `_sent` and
        `_measured` behind the name; `goal`; `late` and `worst`; `age`; `reason` and `said`.
    """
    place = episode.place(time)
    told = {"time": f"{time:.1f}", "end": f"of {episode.end:.1f} s"}
    names = [
        f"{kind}_{who}" for kind in ("linear", "angular") for who in ("asked", "sent", "measured")
    ]
    if place < 0:
        rest = ("goal", "late", "worst", "age", "reason", "said", "grade")
        return told | dict.fromkeys((*names, *rest), NO_VALUE)
    row = episode.ticks.rows[place]
    columns = ("asked_linear", "sent_linear", "linear", "asked_angular", "sent_angular", "angular")
    told |= {
        name: _format_number(row[TICK_PLACES[column]], 2)
        for name, column in zip(names, columns, strict=True)
    }
    late = episode.column("lateness")[: place + 1]
    known = late[np.isfinite(late)]
    return told | {
        "goal": _distance(episode, place),
        "late": _format_milliseconds(late[-1]),
        "worst": _format_milliseconds(known.max()) if len(known) else NO_VALUE,
        "age": _format_number(row[TICK_PLACES["feedback_age"]] * 1e3, 0),
        **_describe_reason(row[TICK_PLACES["reason"]]),
    }


def _format_number(value: float, digits: int) -> str:
    """A number with a true minus sign; a dash for NaN."""
    if not math.isfinite(value):
        return NO_VALUE
    text = f"{value:.{digits}f}"
    return text.replace("-", "\N{MINUS SIGN}") if float(text) else text.removeprefix("-")


def _format_milliseconds(value: float) -> str:
    """A time [s] in milliseconds, with fewer digits where it is long."""
    return _format_number(value * 1e3, 2 if value < 0.01 else 1 if value < 0.1 else 0)


def _distance(episode: GrowingEpisode, place: int) -> str:
    """Distance to the goal by odometry [m]."""
    if episode.goal is None:
        return NO_VALUE
    x, y = episode.column("x")[place], episode.column("y")[place]
    return _format_number(math.hypot(episode.goal[0] - x, episode.goal[1] - y), 2)


def _describe_reason(number: float) -> dict[str, str]:
    """Name, words and grade of a reason."""
    try:
        reason = Reason(int(number))
    except (ValueError, OverflowError):
        return {"reason": NO_VALUE, "said": "unknown", "grade": "0"}
    return {
        "reason": reason.name.replace("_", " ").lower(),
        "said": REASON_WORDS[reason],
        "grade": str(int(reason)),
    }


SEEN_SCANS = 60
"""Scans whose points are drawn as what was seen so far."""
SEEN_CELL = 0.05
"""Points in one square of this side are drawn as one [m]."""
CIRCLE_CORNERS = 24
"""Corners of a circle that is drawn."""
NO_POINTS = np.zeros((0, 2))


def find_world(
    header: dict[str, Any], config: RobotConfig, episode: GrowingEpisode
) -> World | None:
    """Return the world of a simulated episode; None where it isn't known.

    Only worlds of this package's own generators are made again: a recording may name any module.

    Args:
        header: of the recording.
        config: of the robot.
        episode: with the world's number.
    """
    env = header.get("about", {}).get("env")
    options = env.get("kwargs") if isinstance(env, dict) else None
    if not isinstance(options, dict):
        return None
    source, number = options.get("worlds"), episode.info.get("world")
    name = registry.parse_name(source) if isinstance(source, str) else None
    if not (episode.is_simulated and name and not name.module and isinstance(number, int)):
        return None
    try:
        level = options.get("difficulty")
        return Pool.of(str(source), level, footprint_radius(config))[number]
    except (AcsarError, TypeError, ValueError):
        return None


def world_lines(world: World, start: tuple[float, float, float]) -> tuple[Floats, Floats]:
    """Return what to draw of a world, in the odometry frame that begins at `start`.

    Returns:
        Corners of the circles and ends of the segments, (n, 2) each, with rows of NaN between.
    """
    turns = np.linspace(0.0, math.tau, CIRCLE_CORNERS)
    ring = np.stack([np.cos(turns), np.sin(turns)], axis=1)
    circles = [circle[:2] + circle[2] * ring for circle in world.circles]
    segments = list(world.segments.reshape(-1, 2, 2))
    return _place_lines(circles, start), _place_lines(segments, start)


def _place_lines(lines: list[Floats], start: tuple[float, float, float]) -> Floats:
    """Lines in the frame of the world, in the odometry frame, NaN between them."""
    if not lines:
        return NO_POINTS
    gap = np.full((1, 2), np.nan)
    points = np.concatenate([part for line in lines for part in (line, gap)]) - start[:2]
    cos, sin = math.cos(start[2]), math.sin(start[2])
    return np.stack([points @ (cos, sin), points @ (-sin, cos)], axis=1)


def find_hits(episode: GrowingEpisode, config: RobotConfig, time: float) -> tuple[Floats, Floats]:
    """Return where the LiDAR has seen something, in the odometry frame.

    Args:
        episode: with the scans.
        config: of the robot.
        time: until when [s].

    Returns:
        Points of the newest scan, and of those before it, (n, 2) and (m, 2) [m].
    """
    count = int(np.searchsorted(episode.scans.rows[:, 0], time + 1e-9, "right"))
    if not count or episode.ranges is None or not len(episode.ticks):
        return NO_POINTS, NO_POINTS
    chosen = thin_evenly(count, SEEN_SCANS)
    points = _hits(episode, config, chosen)
    newest, before = points[-1], np.concatenate([NO_POINTS, *points[:-1]])
    cells: Floats = np.unique(np.round(before / SEEN_CELL), axis=0)
    return newest, cells * SEEN_CELL


def _hits(episode: GrowingEpisode, config: RobotConfig, scans: Any) -> list[Floats]:
    """Points that each of some scans hit, in the odometry frame."""
    assert episode.ranges is not None  # noqa: S101 - checked by `seen`
    stamps, ticks = episode.scans.rows[scans, 0], episode.column("stamp")
    x, y = (np.interp(stamps, ticks, episode.column(name)) for name in ("x", "y"))
    heading = np.interp(stamps, ticks, np.unwrap(episode.column("theta")))
    spec = ray_spec(config)
    found: list[Floats] = []
    angles = spec.angles() if spec.rays == episode.ranges.rows.shape[1] else None
    for place, row in enumerate(episode.ranges.rows[scans].astype(np.float64)):
        if angles is None:
            break
        hit = np.isfinite(row) & (row < config.lidar.max_range) & (row > 0.0)
        ahead = config.lidar_x_offset + row[hit] * np.cos(angles[hit])
        left = config.lidar_y_offset + row[hit] * np.sin(angles[hit])
        cos, sin = math.cos(heading[place]), math.sin(heading[place])
        found.append(
            np.stack([x[place] + cos * ahead - sin * left, y[place] + sin * ahead + cos * left], 1)
        )
    return found or [NO_POINTS]


WHEELS_SPAN = 20.0
"""How much of the time before now the wheels' charts show [s]."""
LINE_POINTS = 300
"""Points of a line that are drawn; a chart is about as many pixels wide."""
LEAST_LATENESS = 0.01
"""Smallest lateness on the axis, which is logarithmic [ms]."""
REASON_STRIPES = 600
"""Stretches of the episode for each of which one reason is drawn."""
Pair = tuple[float, float]
WHEEL_CHARTS = ((1, "front left"), (0, "front right"), (2, "rear left"), (3, "rear right"))
"""Place in the wheel order and name of each, as seen from above with the front up."""


def draw_wheels(episode: GrowingEpisode, time: float, revision: str) -> Figure:
    """Draw the wheel speeds asked for, sent and measured, in the time before `time` [s]."""
    begin = max(0.0, time - WHEELS_SPAN)
    ticks = slice(max(episode.place(begin), 0), episode.place(time) + 1)
    stamps = episode.column("stamp")[ticks]
    measured = episode.ticks.rows[ticks, TICK_PLACES["speed_a"] : TICK_PLACES["speed_a"] + 4]
    asked, sent = episode.asked(ticks), episode.sent.rows
    first, last = np.searchsorted(sent[:, 0], (begin, time + 1e-9))
    sent = sent[max(first - 1, 0) : last]
    traces: list[Figure] = []
    annotations: list[Figure] = []
    style: dict[str, object] = {"dash": "dot", "width": 2.2}
    steps: dict[str, object] = {"shape": "hv"}
    for place, (wheel, name) in enumerate(WHEEL_CHARTS):
        axes = {"xaxis": f"x{place % 2 + 1}", "yaxis": f"y{place + 1}"}
        traces += [
            _thin_line(stamps, measured[:, wheel], MEASURED_COLOUR, {}) | axes,
            _thin_line(sent[:, 0], sent[:, 1 + wheel], SENT_COLOUR, steps) | axes,
            _thin_line(stamps, asked[:, wheel], ASKED_COLOUR, style) | axes,
        ]
        annotations.append(_title(name, place))
    span = _span(np.concatenate([measured.ravel(), asked.ravel(), sent[:, 1:].ravel()]))
    times = begin, max(time, begin + 1.0)
    return {"data": traces, "layout": _grid(times, span, revision, annotations)}


def _thin_line(x: Floats, y: Floats, colour: str, style: dict[str, object]) -> Figure:
    """A line of few points."""
    chosen = thin_keeping_peaks(y, LINE_POINTS)
    return draw_line(x[chosen], y[chosen], colour, line=style)


def _span(speeds: Floats) -> tuple[float, float]:
    """Limits of the axes, around zero and in steps of 2 rad/s, so that they seldom change."""
    known = np.r_[speeds[np.isfinite(speeds)], 0.0, 2.0]
    low, high = float(known.min()), float(known.max())
    return 2.0 * math.floor(low / 1.9), 2.0 * math.ceil(high / 1.9)


def _title(name: str, place: int) -> Figure:
    """The name of a wheel, in its chart."""
    return {
        "text": f"<b>{name}</b>",
        "showarrow": False,
        "xref": f"x{place % 2 + 1} domain",
        "yref": f"y{place + 1} domain",
        "x": 0.0,
        "y": 1.0,
        "xanchor": "left",
        "yanchor": "bottom",
        "font": {"size": 12, "color": INK_COLOUR},
    }


def _grid(times: Pair, speeds: Pair, revision: str, annotations: list[Figure]) -> Figure:
    """The layout of the four charts."""
    columns, rows = ((0.0, 0.47), (0.53, 1.0)), ((0.55, 0.96), (0.0, 0.41))
    axes: Figure = {}
    for column, domain in enumerate(columns):
        axes[f"xaxis{column + 1}"] = make_axis(
            "time [s]",
            domain=list(domain),
            range=list(times),
            anchor=f"y{column + 3}",
            fixedrange=True,
        )
    for place in range(4):
        axes[f"yaxis{place + 1}"] = make_axis(
            "" if place % 2 else "rad/s",
            domain=list(rows[place // 2]),
            anchor=f"x{place % 2 + 1}",
            range=list(speeds),
            zeroline=True,
            zerolinecolor="#d5d8dc",
            nticks=5,
            fixedrange=True,
        )
    return make_layout(revision, annotations=annotations, **axes)


def draw_lateness(episode: GrowingEpisode, time: float, revision: str) -> Figure:
    """Draw how late ticks ended and why the safety layer stepped in, over the whole episode."""
    end = max(episode.end, 1.0)
    late = np.maximum(episode.column("lateness") * 1e3, LEAST_LATENESS)
    known = late[np.isfinite(late)]
    high = max(10.0, 2.0 * float(known.max())) if len(known) else 10.0
    limit = np.array([0.0, end]), np.full(2, LATE_TICK * 1e3)
    traces = [
        draw_line(*limit, REASON_COLOURS[4], line={"dash": "dash", "width": 1}),
        _thin_line(episode.column("stamp"), late, INK_COLOUR, {"width": 1.2}),
        _draw_reasons(episode, end) | {"yaxis": "y2"},
    ]
    notes = [] if len(known) else [_note("simulated time is never late")]
    cursor = {"type": "line", "x0": time, "x1": time, "y0": 0, "y1": 1, "yref": "paper"}
    layout = make_layout(
        revision,
        annotations=notes,
        margin={"l": 48, "r": 12, "t": 8, "b": 36},
        xaxis=make_axis("time [s]", range=[0.0, end], anchor="y2", fixedrange=True),
        yaxis=make_axis(
            "ms",
            type="log",
            dtick=1,
            domain=[0.3, 1.0],
            range=[math.log10(LEAST_LATENESS), math.log10(high)],
            fixedrange=True,
        ),
        yaxis2={"domain": [0.0, 0.18], "visible": False, "fixedrange": True},
        shapes=[cursor | {"line": {"color": SENT_COLOUR, "width": 1.5}}],
    )
    return {"data": traces, "layout": layout}


def _note(text: str) -> Figure:
    """Words instead of a line."""
    place = {"x": 0.5, "y": 0.65, "xref": "paper", "yref": "paper", "showarrow": False}
    return {
        "text": text,
        "font": {"size": 12, "color": MUTED_COLOUR},
        "bgcolor": PAPER_COLOUR,
        **place,
    }


def _draw_reasons(episode: GrowingEpisode, end: float) -> Figure:
    """A strip with the gravest reason of each stretch of time."""
    edges = np.linspace(0.0, end, REASON_STRIPES + 1)
    places = np.clip(np.searchsorted(edges, episode.column("stamp")) - 1, 0, REASON_STRIPES - 1)
    grave = np.full(REASON_STRIPES, np.nan)
    reasons = np.clip(np.nan_to_num(episode.column("reason")), 0, len(REASON_COLOURS) - 1)
    np.fmax.at(grave, places, reasons)
    if len(places):  # a stretch that is shorter than a tick has none: as the one before it
        held = np.maximum.accumulate(np.where(np.isnan(grave), 0, np.arange(REASON_STRIPES)))
        grave = np.where(edges[:-1] > episode.column("stamp")[-1], np.nan, grave[held])
    steps = len(REASON_COLOURS)
    scale = [[(n + k) / steps, colour] for n, colour in enumerate(REASON_COLOURS) for k in (0, 1)]
    cells = [[None if np.isnan(value) else int(value) for value in grave]]
    colours = {"colorscale": scale, "zmin": -0.5, "zmax": steps - 0.5, "showscale": False}
    return {"type": "heatmap", "x": numbers_of(edges), "z": cells, **colours}


def numbers_of(edges: Floats) -> list[float]:
    """Edges of cells; a heatmap doesn't read them in base64."""
    return [round(float(edge), 4) for edge in edges]


PATH_POINTS = 1500
"""Points of a path that are drawn."""
VIEW_MARGIN, LEAST_VIEW = 1.0, 4.0
"""Space around the path, and smallest side of the view [m]."""


def draw_top_view(
    episode: GrowingEpisode, config: RobotConfig, world: World | None, time: float, revision: str
) -> Figure:
    """Draw an episode at a time since its reset [s]."""
    place, poses = episode.place(time), _poses(episode)
    now, before = find_hits(episode, config, time)
    traces = [draw_specks(before, SEEN_COLOUR, 3, name="seen before")]
    traces += _draw_world(world, episode)
    if episode.is_simulated:
        traces.append(_draw_truth(episode, time))
    chosen, far = thin_evenly(len(poses), PATH_POINTS), SENT_COLOUR + "40"
    done = chosen[chosen <= place]
    traces.append(_draw_path(poses[chosen], far, "path to come"))
    traces.append(
        _draw_path(poses[np.r_[done, place]] if place >= 0 else poses[:0], SENT_COLOUR, "path")
    )
    traces.append(draw_specks(now, SCAN_COLOUR, 4, name="LiDAR now"))
    traces += _draw_goal(episode)
    traces += _draw_robot(config, tuple(poses[place]) if place >= 0 else (0.0, 0.0, 0.0))
    (left, right), (low, high) = _limits(episode, poses)
    return {
        "data": traces,
        "layout": make_layout(
            revision,
            dragmode="pan",
            xaxis=make_axis("x forward [m]", range=[left, right]),
            yaxis=make_axis("y left [m]", range=[low, high], scaleanchor="x", scaleratio=1),
        ),
    }


def _poses(episode: GrowingEpisode) -> Floats:
    """Poses by odometry, (n, 3)."""
    return np.stack([episode.column(name) for name in ("x", "y", "theta")], axis=1)


def _draw_path(points: Floats, colour: str, name: str) -> Figure:
    """A path by odometry."""
    return draw_line(points[:, 0], points[:, 1], colour, name=name, line={"width": 2.5})


def _draw_truth(episode: GrowingEpisode, time: float) -> Figure:
    """The true path of a simulated robot, in the odometry frame."""
    rows = episode.truth.rows
    rows = rows[: int(np.searchsorted(rows[:, 0], time + 1e-9, "right"))]
    rows = rows[thin_evenly(len(rows), PATH_POINTS // 3)]
    points = [to_odometry(episode.start, (x, y, theta))[:2] for x, y, theta in rows[:, 1:].tolist()]
    style = {"dash": "dot", "width": 1.6}
    track = np.array(points, np.float64).reshape(-1, 2)
    return draw_line(track[:, 0], track[:, 1], TRUTH_COLOUR, name="true path", line=style)


def _draw_world(world: World | None, episode: GrowingEpisode) -> list[Figure]:
    """The obstacles of a simulated world."""
    if world is None:
        return []
    circles, segments = world_lines(world, episode.start)
    style: dict[str, Any] = {
        "line": {"width": 1},
        "fill": "toself",
        "fillcolor": WALL_COLOUR + "30",
    }
    walls: dict[str, Any] = {"line": {"width": 2}, "connectgaps": False}
    return [
        draw_line(circles[:, 0], circles[:, 1], WALL_COLOUR, name="obstacles", **style),
        draw_line(segments[:, 0], segments[:, 1], WALL_COLOUR, name="walls", **walls),
    ]


def _draw_goal(episode: GrowingEpisode) -> list[Figure]:
    """The goal, and the start."""
    start = draw_markers(np.zeros((1, 2)), MUTED_COLOUR, 9, name="start")
    start["marker"] |= {"symbol": "cross-thin", "line": {"width": 2, "color": MUTED_COLOUR}}
    if episode.goal is None:
        return [start]
    goal = draw_markers(np.array([episode.goal]), GOAL_COLOUR + "33", 22, name="goal")
    goal["marker"]["line"] = {"width": 2.5, "color": GOAL_COLOUR}
    return [start, goal]


def _draw_robot(config: RobotConfig, pose: tuple[float, ...]) -> list[Figure]:
    """The footprint, and a line that shows where its front is."""
    x, y, theta = pose
    corners = np.array([*config.outline, config.outline[0]])
    ahead = float(corners[:, 0].max())
    turn = np.array([[math.cos(theta), math.sin(theta)], [-math.sin(theta), math.cos(theta)]])
    placed = corners @ turn + (x, y)
    front = np.array([(0.0, 0.0), (ahead, 0.0)]) @ turn + (x, y)
    fill: dict[str, Any] = {"fill": "toself", "fillcolor": INK_COLOUR + "cc"}
    return [
        draw_line(placed[:, 0], placed[:, 1], INK_COLOUR, name="robot", **fill),
        draw_line(front[:, 0], front[:, 1], "#ffffff", name="front", line={"width": 2.5}),
    ]


def _limits(
    episode: GrowingEpisode, poses: Floats
) -> tuple[tuple[float, float], tuple[float, float]]:
    """Limits of x and y that hold path and goal, in whole steps so that they seldom change."""
    points = np.concatenate([np.zeros((1, 2)), poses[:, :2]])
    if episode.goal is not None:
        points = np.concatenate([points, [episode.goal]])
    points = points[np.isfinite(points).all(axis=1)]
    low, high = points.min(axis=0) - VIEW_MARGIN, points.max(axis=0) + VIEW_MARGIN
    more = np.maximum(LEAST_VIEW - (high - low), 0.0) / 2.0
    low, high = np.floor(low - more).tolist(), np.ceil(high + more).tolist()
    return (low[0], high[0]), (low[1], high[1])
