"""The page: which parts it has, and where."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from dash import dcc, html

from acsar_gym.dashboard.readings import NONE
from acsar_gym.dashboard.session import Session
from acsar_gym.errors import printable

RATES = [{"label": f"{rate} x", "value": rate} for rate in ("0.5", "1", "4", "16")]
"""How fast a recording is played."""
QUICK, SLOW = 200, 1000
"""Time between two updates while something moves, and while nothing does [ms]."""
GRAPH = {"displayModeBar": False, "scrollZoom": True, "displaylogo": False, "doubleClick": "reset"}
STATIC = {"displayModeBar": False, "displaylogo": False}


def page(session: Session) -> Any:
    """Make the page of a session."""
    return html.Main(
        [
            _header(session),
            html.P("", id="message", role="status"),
            _tiles(),
            html.Div(
                [
                    _card("From above", _top_key(), "top", GRAPH, "top"),
                    _card("Wheel speeds", _wheel_key(), "wheels", STATIC, "wheels"),
                ],
                className="pair",
            ),
            _card(
                "Lateness of ticks, and the safety layer", _late_key(), "lateness", STATIC, "late"
            ),
            _transport(session),
            dcc.Store(id="playing", data=session.is_live),
            dcc.Store(id="clock", data=0.0),
            dcc.Store(id="seen", data=0),
            dcc.Interval(id="pulse", interval=QUICK if session.is_live else SLOW),
        ]
    )


def about(session: Session) -> str:
    """What was recorded: robot, command, link and policy."""
    told = session.tail.header.get("about", {})
    policy = told.get("policy")
    words = (
        session.tail.config.name,
        told.get("command"),
        told.get("link"),
        Path(str(policy.get("file", ""))).name if isinstance(policy, dict) else None,
    )
    return " · ".join(printable(str(each)[:80]) for each in words if each)


def _header(session: Session) -> Any:
    """Name, state and stop button."""
    name = printable(session.tail.path.name)
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
            _tile("Time", [_value("time"), " s"], [_value("end")]),
            _three("Speed", "linear", "m/s"),
            _three("Turn rate", "angular", "rad/s"),
            _tile("To the goal", [_value("goal"), " m"], ["by odometry"]),
            _tile(
                "Lateness",
                [_value("late"), " ms"],
                ["worst ", _value("worst"), " ms, feedback ", _value("age"), " ms old"],
            ),
            _tile("Safety layer", [_value("reason")], [_value("said")], id="safety"),
        ],
        className="tiles",
    )


def _tile(label: str, value: list[Any], small: list[Any], **more: Any) -> Any:
    """One of them."""
    parts = [html.Span(label, className="label"), html.B(value), html.Span(small)]
    return html.Div(parts, className="tile", **more)


def _three(label: str, name: str, unit: str) -> Any:
    """A tile with what was asked for, sent and measured."""
    kinds = ("asked", "sent", "measured")
    cells = [
        html.Div([html.B(_value(f"{name}_{kind}")), html.Span(kind)], className=kind)
        for kind in kinds
    ]
    heading = html.Span([label, html.I(unit)], className="label")
    return html.Div([heading, html.Div(cells, className="three")], className="tile wide")


def _value(name: str) -> Any:
    """A text that the updates fill in."""
    return html.Span(NONE, id=f"value-{name}")


def _card(title: str, key: Any, graph: str, config: dict[str, Any], kind: str) -> Any:
    """A figure with title and key."""
    heading = html.Div([html.H2(title), key], className="heading")
    plot = dcc.Graph(id=graph, figure={}, config=config, responsive=True)
    return html.Section([heading, plot], className=f"card {kind}")


def _key(*entries: tuple[str, str]) -> Any:
    """What the colours of a figure mean."""
    return html.Div(
        [html.Span([html.I(className=kind), name]) for name, kind in entries], className="key"
    )


def _top_key() -> Any:
    return _key(
        ("path", "line sent"),
        ("LiDAR now", "dot scan"),
        ("seen before", "dot seen"),
        ("goal", "ring goal"),
        ("true path, if simulated", "line truth"),
    )


def _wheel_key() -> Any:
    return _key(("asked", "line asked"), ("sent", "line sent"), ("measured", "line measured"))


def _late_key() -> Any:
    return _key(
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
            dcc.RadioItems(id="rate", options=RATES, value="1", inline=True, className="rates"),
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
