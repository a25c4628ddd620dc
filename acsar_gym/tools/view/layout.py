"""The page: which parts it has, and where."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from dash import dcc, html

from acsar_gym.errors import escape_unprintable
from acsar_gym.tools.view.drawing import NO_VALUE
from acsar_gym.tools.view.session import Session

PLAY_RATES = [{"label": f"{rate} x", "value": rate} for rate in ("0.5", "1", "4", "16")]
"""How fast a recording is played."""
QUICK_UPDATE, SLOW_UPDATE = 200, 1000
"""Time between two updates while something moves, and while nothing does [ms]."""
PANNED_GRAPH = {
    "displayModeBar": False,
    "scrollZoom": True,
    "displaylogo": False,
    "doubleClick": "reset",
}
STATIC_GRAPH = {"displayModeBar": False, "displaylogo": False}


def make_page(session: Session) -> Any:
    """Make the page of a session."""
    return html.Main(
        [
            _header(session),
            html.P("", id="message", role="status"),
            _tiles(),
            html.Div(
                [
                    _make_card("From above", _top_key(), "top", PANNED_GRAPH, "top"),
                    _make_card("Wheel speeds", _wheel_key(), "wheels", STATIC_GRAPH, "wheels"),
                ],
                className="pair",
            ),
            _make_card(
                "Lateness of ticks, and the safety layer",
                _late_key(),
                "lateness",
                STATIC_GRAPH,
                "late",
            ),
            _transport(session),
            dcc.Store(id="playing", data=session.is_live),
            dcc.Store(id="clock", data=0.0),
            dcc.Store(id="seen", data=0),
            dcc.Interval(id="pulse", interval=QUICK_UPDATE if session.is_live else SLOW_UPDATE),
        ]
    )


def describe_run(session: Session) -> str:
    """What was recorded: robot, command, link and policy."""
    told = session.tail.header.get("about", {})
    policy = told.get("policy")
    words = (
        session.tail.config.name,
        told.get("command"),
        told.get("link"),
        Path(str(policy.get("file", ""))).name if isinstance(policy, dict) else None,
    )
    return " · ".join(escape_unprintable(str(each)[:80]) for each in words if each)


def _header(session: Session) -> Any:
    """Name, state and stop button."""
    name = escape_unprintable(session.tail.path.name)
    return html.Header(
        [
            html.Div(
                [
                    html.H1([name, html.Span("", id="state", className="state")]),
                    html.P("", id="about", className="muted"),
                ]
            ),
            html.Div(
                [
                    html.P("", id="stop-said", className="muted", role="alert"),
                    html.Button("Stop robot", id="stop", className="stop"),
                ],
                className="stopping",
                id="stop-box",
            ),
        ]
    )


def _tiles() -> Any:
    """The figures in large type."""
    return html.Div(
        [
            _make_tile("Time", [_make_value("time"), " s"], [_make_value("end")]),
            _make_wide_tile("Speed", "linear", "m/s"),
            _make_wide_tile("Turn rate", "angular", "rad/s"),
            _make_tile("To the goal", [_make_value("goal"), " m"], ["by odometry"]),
            _make_tile(
                "Lateness",
                [_make_value("late"), " ms"],
                ["worst ", _make_value("worst"), " ms, feedback ", _make_value("age"), " ms old"],
            ),
            _make_tile("Safety layer", [_make_value("reason")], [_make_value("said")], id="safety"),
        ],
        className="tiles",
    )


def _make_tile(label: str, value: list[Any], small: list[Any], **more: Any) -> Any:
    """One of them."""
    parts = [html.Span(label, className="label"), html.B(value), html.Span(small)]
    return html.Div(parts, className="tile", **more)


def _make_wide_tile(label: str, name: str, unit: str) -> Any:
    """A tile with what was asked for, sent and measured."""
    kinds = ("asked", "sent", "measured")
    cells = [
        html.Div([html.B(_make_value(f"{name}_{kind}")), html.Span(kind)], className=kind)
        for kind in kinds
    ]
    heading = html.Span([label, html.I(unit)], className="label")
    return html.Div([heading, html.Div(cells, className="three")], className="tile wide")


def _make_value(name: str) -> Any:
    """A text that the updates fill in."""
    return html.Span(NO_VALUE, id=f"value-{name}")


def _make_card(title: str, key: Any, graph: str, config: dict[str, Any], kind: str) -> Any:
    """A figure with title and key."""
    heading = html.Div([html.H2(title), key], className="heading")
    plot = dcc.Graph(id=graph, figure={}, config=config, responsive=True)
    return html.Section([heading, plot], className=f"card {kind}")


def _make_key(*entries: tuple[str, str]) -> Any:
    """What the colours of a figure mean."""
    return html.Div(
        [html.Span([html.I(className=kind), name]) for name, kind in entries], className="key"
    )


def _top_key() -> Any:
    return _make_key(
        ("path", "line sent"),
        ("LiDAR now", "dot scan"),
        ("seen before", "dot seen"),
        ("goal", "ring goal"),
        ("true path, if simulated", "line truth"),
    )


def _wheel_key() -> Any:
    return _make_key(("asked", "line asked"), ("sent", "line sent"), ("measured", "line measured"))


def _late_key() -> Any:
    return _make_key(
        ("late: over 1 ms", "line late"),
        ("as asked", "box none"),
        ("limits", "box limits"),
        ("geofence", "box fence"),
        ("stale feedback", "box stale"),
        ("emergency stop", "box estop"),
    )


def _transport(session: Session) -> Any:
    """Play, slider, rate and episode: they choose what is shown, and don't move the robot."""
    return html.Div(
        [
            html.Button("Play", id="play", n_clicks=0),
            dcc.Slider(
                id="time",
                min=0.0,
                max=1.0,
                step=0.01,
                value=0.0,
                marks=None,
                updatemode="drag",
                allow_direct_input=False,
                className="slider",
            ),
            dcc.RadioItems(
                id="rate", options=PLAY_RATES, value="1", inline=True, className="rates"
            ),
            html.Label(
                [
                    "Episode",
                    dcc.Input(
                        id="episode", type="number", min=1, step=1, value=None, debounce=True
                    ),
                    html.Span("", id="episodes"),
                ],
                className="episode",
            ),
        ],
        className="transport",
    )
