"""The Dash application: which parts the page has, and what they do."""

from __future__ import annotations

import secrets
import time
from bisect import bisect_right
from dataclasses import dataclass
from html import escape
from pathlib import Path
from typing import Any

import dash
from dash import Input, Output, State, ctx, dcc, html, no_update

from acsar_gym.errors import RenderError, escape_unprintable
from acsar_gym.tools.view import session as sessions
from acsar_gym.tools.view.drawing import NO_VALUE
from acsar_gym.tools.view.log import LogLine
from acsar_gym.tools.view.session import Session
from acsar_gym.tools.view.tail import GrowingEpisode

ASSETS = Path(__file__).parent / "assets"
CONTENT_POLICY = (
    "default-src 'self'; script-src 'self' 'unsafe-inline' 'unsafe-eval'; "
    "style-src 'self' 'unsafe-inline'; img-src 'self' data: blob:; connect-src 'self'"
)
"""Content security policy: a browser refuses to load anything from elsewhere."""
LOCAL_HOSTS = ("127.0.0.1", "localhost")
STOP_TOKEN = "stop-token"  # noqa: S105 - only its name
"""Name of the page's mark that a stop has to show, new at every start, and of the header for it."""
OTHER_PLOTS = (
    "Plots of your own: open the recording in Foxglove or PlotJuggler (plotjuggler -d FILE); "
    "a run that is started with --view shows itself live in Foxglove."
)
LINES_BEFORE, LINES_AFTER = 60, 5
"""Lines of the log that are shown, from before and from after the shown time."""
SILENCE_LIMIT = 3.0
"""A live run from which nothing came for so long is told [s]."""
MAX_PLAY_STEP = 1.0
"""Longest step of playing [s]: a browser pauses pages that nobody looks at."""
PLAY_RATES = [{"label": f"{rate} x", "value": rate} for rate in ("0.5", "1", "4", "16")]
"""How fast a recording is played."""
QUICK_UPDATE, SLOW_UPDATE = 200, 1000
"""Time between two updates while something moves, and while nothing does [ms]."""
STATIC_GRAPH = {"displayModeBar": False, "displaylogo": False}
PANNED_GRAPH = STATIC_GRAPH | {"scrollZoom": True, "doubleClick": "reset"}
STATE_WORDS = {
    sessions.LIVE: "live",
    sessions.STOPPED: "stopped",
    sessions.ENDED: "ended",
    sessions.RECORDED: "recorded",
    sessions.BROKEN: "can't be read",
}
GRAPH_NAMES = ("top", "wheels", "lateness")
SPEED_KINDS = ("asked", "sent", "measured")
VALUE_NAMES = (
    *("time", "end", "goal", "late", "worst", "age", "reason", "said", "gap"),
    *(f"{kind}_{who}" for kind in ("linear", "angular") for who in SPEED_KINDS),
)
PAGE_OUTPUTS = {
    **{graph: Output(graph, "figure") for graph in GRAPH_NAMES},
    **{name: Output(f"value-{name}", "children") for name in VALUE_NAMES},
    "slider": Output("time", "value"),
    "longest": Output("time", "max"),
    "playing": Output("playing", "data"),
    "clock": Output("clock", "data"),
    "seen": Output("seen", "data"),
    "run": Output("run", "data"),
    "pulse": Output("pulse", "interval"),
    "play": Output("play", "children"),
    "state": Output("state", "children"),
    "look": Output("state", "className"),
    "box": Output("stop-box", "className"),
    "message": Output("message", "children"),
    "about": Output("about", "children"),
    "episode": Output("episode", "value"),
    "episodes": Output("episodes", "children"),
    "safety": Output("safety", "className"),
    "log": Output("log", "children"),
    "camera": Output("camera-at", "children"),
}
PAGE_INPUTS = {
    "pulse": Input("pulse", "n_intervals"),
    "at": Input("time", "value"),
    "play": Input("play", "n_clicks"),
    "episode": Input("episode", "value"),
    "playing": State("playing", "data"),
    "clock": State("clock", "data"),
    "seen": State("seen", "data"),
    "run": State("run", "data"),
    "longest": State("time", "max"),
    "rate": State("rate", "value"),
}


@dataclass(frozen=True)
class PageInputs:
    """What the page sends: see `PAGE_INPUTS`."""

    pulse: int | None
    at: float | None
    play: int | None
    episode: float | None
    playing: bool
    clock: float
    seen: int
    run: int
    longest: float
    rate: str


def make_app(session: Session) -> dash.Dash:
    """Make the application of a session; it loads nothing from anywhere else."""
    app = dash.Dash(
        "acsar_gym",
        assets_folder=str(ASSETS),
        title=escape(f"{escape_unprintable(session.tail.path.name)} - acsar-gym"),
        update_title="",
        serve_locally=True,
        add_log_handler=False,
        enable_mcp=False,
        meta_tags=[{"name": STOP_TOKEN, "content": (token := secrets.token_urlsafe())}],
    )
    app.layout = lambda: make_page(session)

    def answer(**page: Any) -> dict[str, Any]:
        return update_page(session, PageInputs(**page), ctx.triggered_id, time.monotonic())

    asking = (Output("pulse", "disabled"), True, False)  # no second question before an answer
    app.callback(PAGE_OUTPUTS, PAGE_INPUTS, running=[asking])(answer)
    _add_routes(app.server, session, token)
    return app


def _add_routes(server: Any, session: Session, token: str) -> None:
    """Answer what assets/*.js ask; the stop on a way that no drawing and no lock is in.

    Pages get answers from this computer only, and browsers load nothing from elsewhere.
    """
    from flask import abort, request  # noqa: PLC0415 - optional

    own = secrets.token_hex(8)

    def answer(text: str, code: int = 200) -> Any:
        return text, code, {"Content-Type": "text/plain; charset=utf-8"}

    def stop() -> Any:
        shown = request.headers.get(STOP_TOKEN, "")
        if not secrets.compare_digest(shown.encode(), token.encode()):
            return answer("not stopped: only the page's own button may; run acsar-gym estop\n", 403)
        return answer(escape_unprintable(session.stop().said))

    def camera(run: int, episode: int, row: int) -> Any:
        try:
            return session.draw_picture(run, episode, row), 200, {"Content-Type": "image/png"}
        except RenderError as error:
            return answer(str(error))

    def check() -> None:
        own_origin = f"http://{request.host}"
        is_own = request.headers.get("Origin", own_origin) == own_origin
        if request.host.rsplit(":", 1)[0] not in LOCAL_HOSTS or not is_own:
            abort(403)

    def secure(response: Any) -> Any:
        response.headers["Content-Security-Policy"] = CONTENT_POLICY
        response.headers["X-Frame-Options"] = "DENY"
        return response

    server.add_url_rule("/stop", "stop", stop, methods=["POST"])
    server.add_url_rule("/camera/<int:run>/<int:episode>/<int:row>", "camera", camera)
    server.add_url_rule("/alive", "alive", lambda: answer(own))
    server.before_request(check)
    server.after_request(secure)


def update_page(
    session: Session, page: PageInputs, cause: str | None, now: float
) -> dict[str, Any]:
    """Work out what the page shows next.

    Args:
        session: what is shown.
        page: what the page has sent.
        cause: the part of the page that has changed; None when it was opened.
        now: of a steady clock [s].

    Returns:
        Values of `PAGE_OUTPUTS`.
    """
    revision, live = session.poll(), session.is_live
    begins = session.run != page.run  # what somebody looked at before is gone, or goes on
    playing = page.playing and cause != "episode"
    if begins:
        playing = live
    elif cause == "play":
        playing = not page.playing
    elif cause == "time" and live:  # somebody looks at the past
        playing = False
    follows = live and playing
    count = len(session.tail.episodes)
    asked = int(page.episode or (count if live else 1))
    number = count if follows or begins else min(max(asked, 1), count)
    shown = session.episode(number - 1)
    end = 0.0 if shown is None else shown.end
    at = page.at or 0.0
    followed = page.playing and at >= page.longest and session.state != sessions.RECORDED
    if follows or begins or (cause == "pulse" and followed):  # a live run, which may be over now
        at = end
    elif cause == "episode" or (cause == "play" and at >= end):
        at = 0.0
    elif cause == "pulse" and playing:
        at += min(max(now - page.clock, 0.0), MAX_PLAY_STEP) * float(page.rate)
    at = min(at, end)
    playing = follows or (playing and (at < end or bool(session.problem)))
    state = session.state
    outputs = dict.fromkeys(PAGE_OUTPUTS, no_update) | {
        "state": STATE_WORDS[state],
        "look": f"state {state}",
        "box": "stopping" if session.can_stop else "stopping none",
        "message": escape_unprintable(_find_message(session, shown, number - 1)),
        "about": describe_run(session),
        "pulse": QUICK_UPDATE if live or playing else SLOW_UPDATE,
        "play": "Pause" if playing else "Follow" if live else "Play",
        "playing": playing,
        "clock": now,
        "seen": revision,
        "run": session.run,
    }
    moves = begins or revision != page.seen or (not follows and (playing or page.playing))
    if cause == "pulse" and not moves:  # a browser that draws answers the stop button later
        return outputs
    figures, values = session.draw(number - 1, at)
    outputs |= figures | {name: values[name] for name in VALUE_NAMES if values}
    return outputs | {
        "safety": f"tile reason{values.get('grade', '0')}",
        "camera": values.get("camera", ""),
        "log": make_lines(session.list_lines(number - 1), at),
        "slider": at,
        "longest": max(end, 0.01),
        "episode": number or no_update,
        "episodes": f"of {count}",
    }


def make_lines(lines: list[LogLine], at: float) -> list[Any]:
    """Make the log: the newest line first; a few that come after the shown time are paler."""
    past = bisect_right([line.time for line in lines], at + 1e-9)
    first, last = max(past - LINES_BEFORE, 0), min(past + LINES_AFTER, len(lines))
    shown = []
    for line in reversed(lines[first:last]):
        look = f"level{line.level}" + (" later" if line.time > at + 1e-9 else "")
        told = [html.Span(f"{line.time:.1f} s"), escape_unprintable(line.text)]
        button = html.Button(told, **{"data-time": f"{line.time:.3f}"})
        shown.append(html.Li(button, className=look))
    more = (len(lines) - last, "later", 0), (first, "earlier", LINES_BEFORE + LINES_AFTER + 1)
    for count, where, place in more:
        if count:
            shown.insert(place, html.Li(f"{count:,} {where}", className="more"))
    return shown


def _find_message(session: Session, shown: GrowingEpisode | None, number: int) -> str:
    """What goes wrong, in one line; empty where nothing does."""
    if session.problem:
        return session.problem
    if shown is None:
        return "waiting for the first episode"
    if shown.faults:
        return shown.faults[-1][1]
    age = session.tail.age
    if session.is_live and age > SILENCE_LIMIT:
        return f"nothing new for {age:.0f} s"
    return session.explain_alone(number)


def describe_run(session: Session) -> str:
    """Tell what was recorded: robot, command, link and policy."""
    about = session.tail.header.get("about", {})
    policy = about.get("policy")
    words = (
        session.tail.config.name,
        about.get("command"),
        about.get("link"),
        Path(str(policy.get("file", ""))).name if isinstance(policy, dict) else None,
    )
    return " · ".join(escape_unprintable(str(each)[:80]) for each in words if each)


def make_page(session: Session) -> Any:
    """Make the page of a session."""
    name = escape_unprintable(session.tail.path.name)
    heading = html.H1([name, html.Span("", id="state", className="state")])
    stop = [
        html.P("", id="stop-said", className="muted", role="alert"),
        html.Button("Stop robot", id="stop", className="stop"),
    ]
    header = [
        html.Div([heading, html.P("", id="about", className="muted")]),
        html.Div(stop, className="stopping", id="stop-box"),
    ]
    wheel_key = [(kind, f"line {kind}") for kind in SPEED_KINDS]
    top_key = [
        ("path", "line sent"),
        ("LiDAR now", "dot scan"),
        ("seen before", "dot seen"),
        ("goal", "ring goal"),
        ("true path, if simulated", "line truth"),
    ]
    other = session.overlay
    if other is not None:
        top_key.insert(1, (other.name, "line other"))
        wheel_key.append((f"measured in {other.name}", "line other"))
    late_key = [
        ("late from here on", "line late"),
        ("as asked", "box none"),
        ("limits", "box limits"),
        ("geofence", "box fence"),
        ("stale feedback", "box stale"),
        ("emergency stop", "box estop"),
    ]
    gap = html.P([f"Gap to {other.name}: " if other else "", html.B(id="value-gap")], id="gap")
    pair = [
        _make_card("From above", top_key, "top", PANNED_GRAPH, "top", gap),
        _make_card("Wheel speeds", wheel_key, "wheels", STATIC_GRAPH, "wheels"),
    ]
    log = html.Section([html.H2("Log"), html.Ol([], id="log")], className="card")
    picture = [
        html.Summary(html.H2("Camera")),
        html.P("drawing ...", id="camera-said", className="muted"),
        html.Img(id="camera-picture", alt="What the simulator's camera behind the robot sees"),
        html.Span("", id="camera-at", hidden=True),
    ]
    camera = html.Details(picture, id="camera", className="card")
    late = "Lateness of ticks, and the safety layer"
    return html.Main(
        [
            html.Header(header),
            html.P("", id="message", role="status"),
            html.Div(_make_tiles(), className="tiles"),
            html.Div(pair, className="pair"),
            _make_card(late, late_key, "lateness", STATIC_GRAPH, "late"),
            html.Div([log, camera], className="pair loose"),
            html.P(OTHER_PLOTS, className="muted"),
            html.Div(_make_transport(), className="transport"),
            dcc.Store(id="playing", data=session.is_live),
            dcc.Store(id="clock", data=0.0),
            dcc.Store(id="seen", data=0),
            dcc.Store(id="run", data=session.run),
            dcc.Interval(id="pulse", interval=QUICK_UPDATE if session.is_live else SLOW_UPDATE),
        ]
    )


def _make_tiles() -> list[Any]:
    """The figures in large type."""

    def value(name: str) -> Any:
        return html.Span(NO_VALUE, id=f"value-{name}")

    def tile(label: str, large: list[Any], small: list[Any], **more: Any) -> Any:
        parts = [html.Span(label, className="label"), html.B(large), html.Span(small)]
        return html.Div(parts, className="tile", **more)

    def wide_tile(label: str, name: str, unit: str) -> Any:
        cells = [
            html.Div([html.B(value(f"{name}_{kind}")), html.Span(kind)], className=kind)
            for kind in SPEED_KINDS
        ]
        heading = html.Span([label, html.I(unit)], className="label")
        return html.Div([heading, html.Div(cells, className="three")], className="tile wide")

    worst = ["worst ", value("worst"), " ms, feedback ", value("age"), " ms old"]
    return [
        tile("Time", [value("time"), " s"], [value("end")]),
        wide_tile("Speed", "linear", "m/s"),
        wide_tile("Turn rate", "angular", "rad/s"),
        tile("To the goal", [value("goal"), " m"], ["by odometry"]),
        tile("Lateness", [value("late"), " ms"], worst),
        tile("Safety layer", [value("reason")], [value("said")], id="safety"),
    ]


def _make_card(
    title: str,
    entries: list[tuple[str, str]],
    graph: str,
    config: dict[str, Any],
    kind: str,
    *more: Any,
) -> Any:
    """A figure with its title, and what its colours mean; `more` stands above the figure."""
    key = [html.Span([html.I(className=look), name]) for name, look in entries]
    heading = html.Div([html.H2(title), html.Div(key, className="key")], className="heading")
    plot = dcc.Graph(id=graph, figure={}, config=config, responsive=True)
    return html.Section([heading, *more, plot], className=f"card {kind}")


def _make_transport() -> list[Any]:
    """Play, slider, rate and episode: they choose what is shown, and don't move the robot."""
    times: dict[str, Any] = {"min": 0.0, "max": 1.0, "step": 0.01, "value": 0.0, "marks": None}
    look: dict[str, Any] = {"updatemode": "drag", "allow_direct_input": False}
    number = dcc.Input(id="episode", type="number", min=1, step=1, value=None, debounce=True)
    return [
        html.Button("Play", id="play", n_clicks=0),
        dcc.Slider(id="time", **times, **look, className="slider"),
        dcc.RadioItems(id="rate", options=PLAY_RATES, value="1", inline=True, className="rates"),
        html.Label(["Episode", number, html.Span("", id="episodes")], className="episode"),
    ]
