"""What the page shows of an episode at a time: plotly figures, and figures in words."""

from __future__ import annotations

import base64
import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from acsar_gym.config import RobotConfig
from acsar_gym.errors import AcsarError
from acsar_gym.lidar.scan import ray_spec
from acsar_gym.recording.types import Floats
from acsar_gym.safety.rules import Reason
from acsar_gym.tools.view.log import REASON_WORDS
from acsar_gym.tools.view.overlay import Partner, measure_gaps, measure_true_gap
from acsar_gym.tools.view.tail import TICK_PLACES, GrowingEpisode
from acsar_gym.worlds import World
from acsar_gym.worlds.pool import Pool
from acsar_gym.worlds.registry import parse_name
from acsar_gym.worlds.search import footprint_radius
from acsar_gym.worlds.world import to_odometry

COLOURS = {
    "ink": "#1c1e21",
    "muted": "#62676e",
    "grid": "#ececee",
    "paper": "#ffffff",
    "asked": "#868c94",
    "sent": "#1f5fd6",
    "measured": "#d9640a",
    "goal": "#1a8f5a",
    "scan": "#0f8b8d",
    "seen": "#c3ccd4",
    "wall": "#6b7280",
    "truth": "#9b6bd3",
    "other": "#c2267d",
}
"""Those that dashboard.css has too, have the same name there."""
REASON_COLOURS = ("#dfe9e2", "#f2cf66", "#9b6bd3", "#ef8a3c", "#c81e2b")
"""Of each `safety.rules.Reason`."""
PAGE_FONT = {"family": "system-ui, 'Segoe UI', Roboto, 'Helvetica Neue', Arial, sans-serif"}
NO_VALUE = "\N{EN DASH}"
WHEEL_CHARTS = ((1, "front left"), (0, "front right"), (2, "rear left"), (3, "rear right"))
"""Place in the wheel order and name of each, as seen from above with the front up."""
WHEELS_SPAN = 20.0
"""How much of the time before now the wheels' charts show [s]."""
LINE_POINTS = 300
"""Points of a line over time that are drawn; a chart is about as many pixels wide."""
PATH_POINTS = 1500
"""Points of a path that are drawn."""
REASON_STRIPES = 600
"""Stretches of the episode for each of which one reason is drawn."""
LEAST_LATENESS = 0.01
"""Smallest lateness on the axis, which is logarithmic [ms]."""
VIEW_MARGIN, LEAST_VIEW = 1.0, 4.0
"""Space around the path, and smallest side of the view [m]."""
SPECK_LENGTH = 0.001
"""Length of the pieces of a line that are points [m]."""
SEEN_SCANS = 60
"""Scans whose points are drawn as what was seen so far."""
SEEN_CELL = 0.05
"""Points in one square of this side are drawn as one [m]."""
CIRCLE_CORNERS = 24
"""Corners of a circle that is drawn."""
NO_POINTS = np.zeros((0, 2))

Figure = dict[str, Any]


def thin_keeping_peaks(values: Floats, most: int) -> NDArray[np.intp]:
    """Choose points of a line that is drawn, so that no peak is lost.

    Args:
        values: (n,) of the line; NaN is a gap.
        most: points at most.

    Returns:
        Their numbers, ascending: the least and the largest one of each of `most` / 2 stretches.
    """
    if len(values) <= most:
        return np.arange(len(values))
    edges = np.linspace(0, len(values), most // 2 + 1).astype(np.intp)[:-1]
    size = int(np.diff(edges).max()) + 1
    places = np.minimum(
        edges[:, None] + np.arange(size), np.r_[edges[1:], len(values)][:, None] - 1
    )
    found = values[places]
    known = ~np.isnan(found)
    low = np.where(known, found, np.inf).argmin(axis=1)
    high = np.where(known, found, -np.inf).argmax(axis=1)
    rows = np.arange(len(edges))
    return np.unique(np.concatenate([places[rows, low], places[rows, high]]))


def thin_evenly(count: int, most: int) -> NDArray[np.intp]:
    """Choose at most `most` of `count` points, the first and the last one among them."""
    if count <= most:
        return np.arange(count)
    return np.unique(np.linspace(0, count - 1, most).astype(np.intp))


def _pack_numbers(values: NDArray[Any]) -> dict[str, str]:
    """An array as plotly.js reads it fastest: 32-bit floats in base64."""
    data = np.ascontiguousarray(values, "<f4").tobytes()
    return {"dtype": "f4", "bdata": base64.b64encode(data).decode()}


def _make_layout(revision: str, **more: Any) -> Figure:
    """A plotly layout; zoom and pan are kept for as long as `revision` is the same."""
    return {
        "font": PAGE_FONT | {"size": 12, "color": COLOURS["ink"]},
        "paper_bgcolor": COLOURS["paper"],
        "plot_bgcolor": COLOURS["paper"],
        "showlegend": False,
        "hovermode": False,
        "uirevision": revision,
        "margin": {"l": 48, "r": 12, "t": 12, "b": 36},
        **more,
    }


def _make_axis(title: str, **more: Any) -> Figure:
    """A plotly axis."""
    muted = {"color": COLOURS["muted"]}
    return {
        "title": {"text": title, "standoff": 6, "font": {"size": 12} | muted},
        "gridcolor": COLOURS["grid"],
        "zeroline": False,
        "linecolor": COLOURS["grid"],
        "tickfont": {"size": 11} | muted,
        **more,
    }


def _draw_line(x: Floats, y: Floats, colour: str, name: str = "", **more: Any) -> Figure:
    """A plotly line, 1.6 px wide unless `line` says otherwise."""
    style = {"color": colour, "width": 1.6} | more.pop("line", {})
    numbers = {"x": _pack_numbers(x), "y": _pack_numbers(y)}
    return {"type": "scatter", "mode": "lines", "name": name, "line": style, **numbers, **more}


def _draw_path(points: Floats, colour: str, name: str, **more: Any) -> Figure:
    return _draw_line(points[:, 0], points[:, 1], colour, name, **more)


def _draw_specks(points: Floats, colour: str, size: float, name: str) -> Figure:
    """Many points (n, 2) as one plotly line, which a browser draws much faster than markers.

    The line is in pieces of almost no length, to which dashboard.css gives round ends.
    """
    gap = np.full(len(points), np.nan)
    x = np.stack([points[:, 0], points[:, 0] + SPECK_LENGTH, gap], axis=1).ravel()
    y = np.stack([points[:, 1], points[:, 1], gap], axis=1).ravel()
    return _draw_line(x, y, colour, name, line={"width": size, "simplify": False})


def _draw_marker(
    point: tuple[float, float], name: str, colour: str, size: float, **style: Any
) -> Figure:
    points = np.array([point])
    return {
        "type": "scatter",
        "mode": "markers",
        "name": name,
        "x": _pack_numbers(points[:, 0]),
        "y": _pack_numbers(points[:, 1]),
        "marker": {"color": colour, "size": size, **style},
    }


def draw_episode_from_above(
    episode: GrowingEpisode,
    config: RobotConfig,
    world: World | None,
    at: float,
    revision: str,
    other: Partner | None = None,
) -> Figure:
    """Draw the robot, its path and its surroundings from above, in the odometry frame.

    Args:
        episode: what is shown.
        config: of the robot.
        world: obstacles, in their own frame; None where they aren't known.
        at: time since the reset [s].
        revision: what zoom and pan belong to; they are kept for as long as it is the same.
        other: what is drawn over it: paths, robot, and a line between the robots.

    Returns:
        `data` and `layout` of plotly.
    """
    goal = episode.goal
    scan, seen = find_hits(episode, config, at)
    traces = [_draw_specks(seen, COLOURS["seen"], 3, "seen before")]
    if world is not None:
        circles, segments = world_lines(world, episode.start)
        wall = COLOURS["wall"]
        filled = {"fill": "toself", "fillcolor": wall + "30"}
        traces += [
            _draw_path(circles, wall, "obstacles", line={"width": 1}, **filled),
            _draw_path(segments, wall, "walls", line={"width": 2}, connectgaps=False),
        ]
    drawn = [(episode, config, at, "")]
    if other is not None:
        drawn.insert(0, (other.episode, other.config, at + other.shift, "other "))
    for one, _, time, whose in drawn:
        traces += _draw_paths(one, time, whose)
    traces.append(_draw_specks(scan, COLOURS["scan"], 4, "LiDAR now"))
    cross = {"symbol": "cross-thin", "line": {"width": 2, "color": COLOURS["muted"]}}
    traces.append(_draw_marker((0.0, 0.0), "start", COLOURS["muted"], 9, **cross))
    if goal is not None:
        ring = {"line": {"width": 2.5, "color": COLOURS["goal"]}}
        traces.append(_draw_marker(goal, "goal", COLOURS["goal"] + "33", 22, **ring))
    poses = [one.pose(time) for one, _, time, _ in drawn]
    if other is not None:
        ends = np.array(poses)[:, :2]
        traces.append(_draw_path(ends, COLOURS["other"], "gap", line={"dash": "dot"}))
    for (_, robot, _, whose), (x, y, theta) in zip(drawn, poses, strict=True):
        turn = np.array([[math.cos(theta), math.sin(theta)], [-math.sin(theta), math.cos(theta)]])
        corners = np.array([*robot.outline, robot.outline[0]])
        front = np.array([(0.0, 0.0), (float(corners[:, 0].max()), 0.0)])
        ink = COLOURS["other"] if whose else COLOURS["ink"]
        body = {"fill": "toself", "fillcolor": ink + ("99" if whose else "cc")}
        traces += [
            _draw_path(corners @ turn + (x, y), ink, whose + "robot", **body),
            _draw_path(front @ turn + (x, y), "#ffffff", whose + "front", line={"width": 2.5}),
        ]
    goals = NO_POINTS if goal is None else np.array([goal])
    paths = [one.poses[:, :2] for one, *_ in drawn]
    points = np.concatenate([np.zeros((1, 2)), *paths, goals])
    points = points[np.isfinite(points).all(axis=1)]
    low, high = points.min(axis=0) - VIEW_MARGIN, points.max(axis=0) + VIEW_MARGIN
    more = np.maximum(LEAST_VIEW - (high - low), 0.0) / 2.0
    low, high = np.floor(low - more).tolist(), np.ceil(high + more).tolist()  # seldom change
    square = {"scaleanchor": "x", "scaleratio": 1}
    layout = _make_layout(
        revision,
        dragmode="pan",
        xaxis=_make_axis("x forward [m]", range=[low[0], high[0]]),
        yaxis=_make_axis("y left [m]", range=[low[1], high[1]], **square),
    )
    return {"data": traces, "layout": layout}


def _draw_paths(episode: GrowingEpisode, at: float, whose: str) -> list[Figure]:
    """The path by odometry, paler where it is to come, and the true one where it is known."""
    colour, true_colour = (COLOURS["other"],) * 2 if whose else (COLOURS["sent"], COLOURS["truth"])
    traces, poses, place = [], episode.poses, episode.place(at)
    if episode.is_simulated:
        rows = episode.truth.rows[: episode.count_truth(at)]
        rows = rows[thin_evenly(len(rows), PATH_POINTS // 3)]
        true = [to_odometry(episode.start, (x, y, yaw)) for x, y, yaw in rows[:, 1:4].tolist()]
        points = np.array(true, np.float64).reshape(-1, 3)
        traces.append(_draw_path(points, true_colour, whose + "true path", line={"dash": "dot"}))
    chosen = thin_evenly(len(poses), PATH_POINTS)
    done, wide = np.r_[chosen[chosen <= place], [place] * (place >= 0)], {"width": 2.5}
    return [
        *traces,
        _draw_path(poses[chosen], colour + "40", whose + "path to come", line=wide),
        _draw_path(poses[done.astype(np.intp)], colour, whose + "path", line=wide),
    ]


def world_lines(world: World, start: tuple[float, float, float]) -> tuple[Floats, Floats]:
    """Return what to draw of a world, in the odometry frame that begins at `start`.

    Returns:
        Corners of the circles and ends of the segments, (n, 2) each, with rows of NaN between.
    """
    turns = np.linspace(0.0, math.tau, CIRCLE_CORNERS)
    ring = np.stack([np.cos(turns), np.sin(turns)], axis=1)
    circles = [circle[:2] + circle[2] * ring for circle in world.circles]
    gap, found = np.full((1, 2), np.nan), []
    cos, sin = math.cos(start[2]), math.sin(start[2])
    for lines in (circles, list(world.segments.reshape(-1, 2, 2))):
        points = np.concatenate([NO_POINTS, *(part for line in lines for part in (line, gap))])
        points -= start[:2]
        found.append(np.stack([points @ (cos, sin), points @ (-sin, cos)], axis=1))
    return found[0], found[1]


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
    name = parse_name(source) if isinstance(source, str) else None
    if not (episode.is_simulated and name and not name.module and isinstance(number, int)):
        return None
    try:
        level = options.get("difficulty")
        return Pool.of(str(source), level, footprint_radius(config))[number]
    except (AcsarError, TypeError, ValueError):
        return None


def find_hits(episode: GrowingEpisode, config: RobotConfig, at: float) -> tuple[Floats, Floats]:
    """Return where the LiDAR has seen something, in the odometry frame.

    Args:
        episode: with the scans.
        config: of the robot.
        at: until when [s].

    Returns:
        Points of the newest scan, and of those before it, (n, 2) and (m, 2) [m].
    """
    count = int(np.searchsorted(episode.scans.rows[:, 0], at + 1e-9, "right"))
    spec = ray_spec(config)
    if not count or episode.ranges is None or not len(episode.ticks):
        return NO_POINTS, NO_POINTS
    if spec.rays != episode.ranges.rows.shape[1]:
        return NO_POINTS, NO_POINTS
    chosen = thin_evenly(count, SEEN_SCANS)
    stamps, ticks, angles = episode.scans.rows[chosen, 0], episode.column("stamp"), spec.angles()
    x, y = (np.interp(stamps, ticks, episode.column(name)) for name in ("x", "y"))
    heading = np.interp(stamps, ticks, np.unwrap(episode.column("theta")))
    hits = []
    for place, row in enumerate(episode.ranges.rows[chosen].astype(np.float64)):
        hit = np.isfinite(row) & (row < config.lidar.max_range) & (row > 0.0)
        ahead = config.lidar_x_offset + row[hit] * np.cos(angles[hit])
        left = config.lidar_y_offset + row[hit] * np.sin(angles[hit])
        cos, sin = math.cos(heading[place]), math.sin(heading[place])
        hits.append(
            np.stack([x[place] + cos * ahead - sin * left, y[place] + sin * ahead + cos * left], 1)
        )
    before = np.concatenate([NO_POINTS, *hits[:-1]])
    cells: Floats = np.unique(np.round(before / SEEN_CELL), axis=0)
    return hits[-1], cells * SEEN_CELL


def draw_wheels(
    episode: GrowingEpisode, at: float, revision: str, other: Partner | None = None
) -> Figure:
    """Draw the wheel speeds asked for, sent and measured, in the time before `at` [s].

    Of another run that is drawn over it, only those measured.
    """
    begin = max(0.0, at - WHEELS_SPAN)
    ticks = slice(max(episode.place(begin), 0), episode.place(at) + 1)
    stamps, measured = episode.column("stamp")[ticks], episode.measured[ticks]
    asked, sent = episode.asked(ticks), episode.sent.rows
    first, last = np.searchsorted(sent[:, 0], (begin, at + 1e-9))
    sent = sent[max(first - 1, 0) : last]
    lines: list[tuple[str, Floats, Floats, dict[str, Any]]] = [
        ("measured", stamps, measured, {}),
        ("sent", sent[:, 0], sent[:, 1:], {"shape": "hv"}),
        ("asked", stamps, asked, {"dash": "dot", "width": 2.2}),
    ]
    if other is not None:
        theirs = other.episode
        first, last = theirs.place(begin + other.shift), theirs.place(at + other.shift)
        shown = slice(max(first, 0), last + 1)
        stamps = theirs.column("stamp")[shown] - other.shift
        lines.append(("other", stamps, theirs.measured[shown], {}))
    speeds = np.concatenate([values.ravel() for _, _, values, _ in lines])
    known = np.r_[speeds[np.isfinite(speeds)], 0.0, 2.0]
    low, high = float(known.min()), float(known.max())
    limits = [2.0 * math.floor(low / 1.9), 2.0 * math.ceil(high / 1.9)]  # seldom change
    columns, rows = ([0.0, 0.47], [0.53, 1.0]), ([0.55, 0.96], [0.0, 0.41])
    traces, annotations, axes = [], [], {}
    for place, (wheel, name) in enumerate(WHEEL_CHARTS):
        column = place % 2
        x_axis, y_axis = f"x{column + 1}", f"y{place + 1}"
        for what, when, values, style in lines:
            line = _draw_thinned(when, values[:, wheel], COLOURS[what], style)
            traces.append(line | {"xaxis": x_axis, "yaxis": y_axis})
        annotations.append(
            {
                "text": f"<b>{name}</b>",
                "showarrow": False,
                "xref": f"{x_axis} domain",
                "yref": f"{y_axis} domain",
                "x": 0.0,
                "y": 1.0,
                "xanchor": "left",
                "yanchor": "bottom",
                "font": {"size": 12, "color": COLOURS["ink"]},
            }
        )
        axes[f"xaxis{column + 1}"] = _make_axis(
            "time [s]",
            domain=columns[column],
            range=[begin, max(at, begin + 1.0)],
            anchor=f"y{column + 3}",
            fixedrange=True,
        )
        axes[f"yaxis{place + 1}"] = _make_axis(
            "" if column else "rad/s",
            domain=rows[place // 2],
            anchor=x_axis,
            range=limits,
            zeroline=True,
            zerolinecolor="#d5d8dc",
            nticks=5,
            fixedrange=True,
        )
    return {"data": traces, "layout": _make_layout(revision, annotations=annotations, **axes)}


def _draw_thinned(x: Floats, y: Floats, colour: str, style: dict[str, Any]) -> Figure:
    """A line of few points."""
    chosen = thin_keeping_peaks(y, LINE_POINTS)
    return _draw_line(x[chosen], y[chosen], colour, line=style)


def draw_lateness(episode: GrowingEpisode, late_tick: float, at: float, revision: str) -> Figure:
    """Draw how late ticks ended and why the safety layer stepped in, over the whole episode."""
    end = max(episode.end, 1.0)
    late = np.maximum(episode.column("lateness") * 1e3, LEAST_LATENESS)
    known = late[np.isfinite(late)]
    high = max(10.0, 2.0 * float(known.max())) if len(known) else 10.0
    limit, dashed = np.full(2, late_tick * 1e3), {"dash": "dash", "width": 1}
    traces = [
        _draw_line(np.array([0.0, end]), limit, REASON_COLOURS[4], line=dashed),
        _draw_thinned(episode.column("stamp"), late, COLOURS["ink"], {"width": 1.2}),
        _draw_reasons(episode, end) | {"yaxis": "y2"},
    ]
    note = {
        "text": "simulated time is never late",
        "font": {"size": 12, "color": COLOURS["muted"]},
        "bgcolor": COLOURS["paper"],
        "x": 0.5,
        "y": 0.65,
        "xref": "paper",
        "yref": "paper",
        "showarrow": False,
    }
    cursor = {
        "type": "line",
        "x0": at,
        "x1": at,
        "y0": 0,
        "y1": 1,
        "yref": "paper",
        "line": {"color": COLOURS["sent"], "width": 1.5},
    }
    layout = _make_layout(
        revision,
        annotations=[] if len(known) else [note],
        margin={"l": 48, "r": 12, "t": 8, "b": 36},
        xaxis=_make_axis("time [s]", range=[0.0, end], anchor="y2", fixedrange=True),
        yaxis=_make_axis(
            "ms",
            type="log",
            dtick=1,
            domain=[0.3, 1.0],
            range=[math.log10(LEAST_LATENESS), math.log10(high)],
            fixedrange=True,
        ),
        yaxis2={"domain": [0.0, 0.18], "visible": False, "fixedrange": True},
        shapes=[cursor],
    )
    return {"data": traces, "layout": layout}


def _draw_reasons(episode: GrowingEpisode, end: float) -> Figure:
    """A strip with the gravest reason of each stretch of time."""
    stamps, steps = episode.column("stamp"), len(REASON_COLOURS)
    edges = np.linspace(0.0, end, REASON_STRIPES + 1)
    places = np.clip(np.searchsorted(edges, stamps) - 1, 0, REASON_STRIPES - 1)
    grave = np.full(REASON_STRIPES, np.nan)
    np.fmax.at(grave, places, np.clip(np.nan_to_num(episode.column("reason")), 0, steps - 1))
    if len(places):  # a stretch that is shorter than a tick has none: as the one before it
        held = np.maximum.accumulate(np.where(np.isnan(grave), 0, np.arange(REASON_STRIPES)))
        grave = np.where(edges[:-1] > stamps[-1], np.nan, grave[held])
    return {
        "type": "heatmap",
        "x": [round(float(edge), 4) for edge in edges],  # a heatmap doesn't read base64
        "z": [[None if np.isnan(value) else int(value) for value in grave]],
        "colorscale": [
            [(n + k) / steps, colour] for n, colour in enumerate(REASON_COLOURS) for k in (0, 1)
        ],
        "zmin": -0.5,
        "zmax": steps - 0.5,
        "showscale": False,
    }


def read_values(episode: GrowingEpisode, at: float) -> dict[str, str]:
    """Return the texts of the page's tiles.

    Args:
        episode: what is shown.
        at: time since its reset [s].

    Returns:
        `time`, `end`; `linear` and `angular` as asked, sent and measured, with `_asked`, `_sent`
        and `_measured` behind the name; `goal`; `late` and `worst`; `age`; `reason`, `said` and
        `grade`.
    """
    place, row = episode.place(at), dict.fromkeys(TICK_PLACES, math.nan)
    late = episode.column("lateness")[: place + 1]
    known = late[np.isfinite(late)]
    worst = float(known.max()) if len(known) else math.nan
    distance, reason = math.nan, {"reason": NO_VALUE, "said": NO_VALUE, "grade": NO_VALUE}
    if place >= 0:
        row = dict(zip(TICK_PLACES, episode.ticks.rows[place].tolist(), strict=True))
        if episode.goal is not None:
            distance = math.hypot(episode.goal[0] - row["x"], episode.goal[1] - row["y"])
        reason = _describe_reason(row["reason"])
    speeds = {
        f"{kind}_{who}": format_number(row[f"{who}_{kind}" if who != "measured" else kind], 2)
        for kind in ("linear", "angular")
        for who in ("asked", "sent", "measured")
    }
    return {
        "time": f"{at:.1f}",
        "end": f"of {episode.end:.1f} s",
        **speeds,
        "goal": format_number(distance, 2),
        "late": format_milliseconds(row["lateness"]),
        "worst": format_milliseconds(worst),
        "age": format_number(row["feedback_age"] * 1e3, 0),
        **reason,
    }


def describe_gap(episode: GrowingEpisode, other: Partner | None, at: float) -> str:
    """Tell how far apart two runs are at a time [s]; empty where that isn't known."""
    if other is None or not len(episode.ticks) or not len(other.episode.ticks):
        return ""
    stamps = episode.column("stamp")[: episode.place(at) + 1]
    times = np.r_[stamps[thin_evenly(len(stamps), PATH_POINTS)], at]
    gaps = measure_gaps(episode, other, times)
    largest = format_number(float(gaps[:, 0].max()) * 100.0, 1)
    text = f"{_format_gap(gaps[-1, 0], gaps[-1, 1])} by odometry (at most {largest} cm so far)"
    if episode.is_simulated and other.episode.is_simulated:
        text += f"; true: {_format_gap(*measure_true_gap(episode, other, at))}"
    return text


def _format_gap(distance: float, turn: float) -> str:
    return f"{format_number(distance * 100.0, 1)} cm, {format_number(math.degrees(turn), 1)}°"


def format_number(value: float, digits: int) -> str:
    """Format a number with a true minus sign; a dash for NaN."""
    if not math.isfinite(value):
        return NO_VALUE
    text = f"{value:.{digits}f}"
    return text.replace("-", "\N{MINUS SIGN}") if float(text) else text.removeprefix("-")


def format_milliseconds(value: float) -> str:
    """Format a time [s] in milliseconds, with fewer digits where it is long."""
    return format_number(value * 1e3, 2 if value < 0.01 else 1 if value < 0.1 else 0)


def _describe_reason(number: float) -> dict[str, str]:
    """Name, words and grade of a reason."""
    try:
        reason = Reason(int(number))
    except (ValueError, OverflowError):
        return {"reason": NO_VALUE, "said": "unknown", "grade": "0"}
    name = reason.name.replace("_", " ").lower()
    return {"reason": name, "said": REASON_WORDS[reason], "grade": str(int(reason))}
