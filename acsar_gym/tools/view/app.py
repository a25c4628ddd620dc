"""The Dash application: what the page's parts do."""

from __future__ import annotations

import html
import secrets
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import dash
from dash import Input, Output, State, ctx, no_update

from acsar_gym.errors import escape_unprintable
from acsar_gym.tools.view import layout
from acsar_gym.tools.view import session as sessions
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
SILENCE_LIMIT = 3.0
"""A live run from which nothing came for so long is told [s]."""
MAX_PLAY_STEP = 1.0
"""Longest step of playing [s]: a browser pauses pages that nobody looks at."""
VALUE_NAMES = (
    *("time", "end", "goal", "late", "worst", "age", "reason", "said"),
    *(f"{kind}_{who}" for kind in ("linear", "angular") for who in ("asked", "sent", "measured")),
)
STATE_WORDS = {
    sessions.LIVE: "live",
    sessions.STOPPED: "stopped",
    sessions.ENDED: "ended",
    sessions.RECORDED: "recorded",
    sessions.BROKEN: "can't be read",
}
GRAPH_NAMES = ("top", "wheels", "lateness")
PAGE_OUTPUTS = {
    **{graph: Output(graph, "figure") for graph in GRAPH_NAMES},
    **{name: Output(f"value-{name}", "children") for name in VALUE_NAMES},
    "slider": Output("time", "value"),
    "longest": Output("time", "max"),
    "playing": Output("playing", "data"),
    "clock": Output("clock", "data"),
    "seen": Output("seen", "data"),
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
}
PAGE_INPUTS = {
    "pulse": Input("pulse", "n_intervals"),
    "at": Input("time", "value"),
    "play": Input("play", "n_clicks"),
    "episode": Input("episode", "value"),
    "playing": State("playing", "data"),
    "clock": State("clock", "data"),
    "seen": State("seen", "data"),
    "longest": State("time", "max"),
    "rate": State("rate", "value"),
}


@dataclass(frozen=True)
class PageInputs:
    """What the page sends: see `INPUTS`."""

    pulse: int | None
    at: float | None
    play: int | None
    episode: float | None
    playing: bool
    clock: float
    seen: int
    longest: float
    rate: str


def make_app(session: Session) -> dash.Dash:
    """Make the application of a session; it loads nothing from anywhere else."""
    app = dash.Dash(
        "acsar_gym",
        assets_folder=str(ASSETS),
        title=html.escape(f"{escape_unprintable(session.tail.path.name)} - acsar-gym"),
        update_title="",
        serve_locally=True,
        add_log_handler=False,
        enable_mcp=False,
        meta_tags=[{"name": STOP_TOKEN, "content": (token := secrets.token_urlsafe())}],
    )
    app.layout = lambda: layout.make_page(session)
    asking = [
        (Output("pulse", "disabled"), True, False)
    ]  # never a second question before an answer
    app.callback(PAGE_OUTPUTS, PAGE_INPUTS, running=asking)(PageUpdate(session))
    _serve(app.server, session, token)
    _guard(app.server)
    return app


class PageUpdate:
    """Works out what the page shows next.

    Args:
        session: what is shown.
    """

    def __init__(self, session: Session) -> None:
        self._session = session

    def __call__(self, **page: Any) -> dict[str, Any]:
        """Answer the page: from its inputs, by name, to its outputs."""
        return self.answered(PageInputs(**page), ctx.triggered_id, time.monotonic())

    def answered(self, page: PageInputs, cause: str | None, now: float) -> dict[str, Any]:
        """Work out the outputs.

        Args:
            page: what the page has sent.
            cause: the part of the page that has changed; None when it was opened.
            now: of a steady clock [s].
        """
        session = self._session
        revision, live = session.poll(), session.is_live
        playing = _playing(page, cause, live=live)
        follows = live and playing
        count = len(session.tail.episodes)
        asked = int(page.episode or (count if live else 1))
        number = count if follows else min(max(asked, 1), count)
        shown = session.episode(number - 1)
        end = 0.0 if shown is None else shown.end
        step = min(max(now - page.clock, 0.0), MAX_PLAY_STEP) * float(page.rate)
        at = _moved(page, cause, end, step if playing else 0.0)
        if follows or (cause == "pulse" and self._has_followed(page)):
            at = end
        playing = follows or (playing and (at < end or bool(session.problem)))
        told = self._state(shown, live=live, playing=playing)
        told |= {"playing": playing, "clock": now, "seen": revision}
        moves = revision != page.seen or (not follows and (playing or page.playing))
        if cause == "pulse" and not moves:  # a browser that draws answers the stop button later
            return dict.fromkeys(PAGE_OUTPUTS, no_update) | told
        return (
            told
            | self._pictures(number - 1, at)
            | {
                "slider": at,
                "longest": max(end, 0.01),
                "episode": number or no_update,
                "episodes": f"of {count}",
            }
        )

    def _has_followed(self, page: PageInputs) -> bool:
        """Whether the page was at the end of a live run, which is over now."""
        is_last = (page.at or 0.0) >= page.longest
        return page.playing and is_last and self._session.state != sessions.RECORDED

    def _state(self, shown: GrowingEpisode | None, *, live: bool, playing: bool) -> dict[str, Any]:
        """What the head of the page tells, and how often it asks again."""
        session = self._session
        state = session.state
        return {
            "state": STATE_WORDS[state],
            "look": f"state {state}",
            "box": "stopping" if session.can_stop else "stopping none",
            "message": _message(session, shown),
            "about": layout.describe_run(session),
            "pulse": layout.QUICK_UPDATE if live or playing else layout.SLOW_UPDATE,
            "play": "Pause" if playing else "Follow" if live else "Play",
        }

    def _pictures(self, number: int, at: float) -> dict[str, Any]:
        """Figures, and figures in words."""
        frame = self._session.frame(number, at)
        told: dict[str, Any] = dict.fromkeys((*GRAPH_NAMES, *VALUE_NAMES, "safety"), no_update)
        shown = {name: frame.readings[name] for name in VALUE_NAMES if frame.readings}
        grade = frame.readings.get("grade", "0")
        return told | frame.figures | shown | {"safety": f"tile reason{grade}"}


def _playing(page: PageInputs, cause: str | None, *, live: bool) -> bool:
    """Whether time goes on."""
    if cause == "play":
        return not page.playing
    if cause == "time" and live:  # somebody looks at the past
        return False
    return page.playing and cause != "episode"


def _moved(page: PageInputs, cause: str | None, end: float, step: float) -> float:
    """Return the time to show, within the episode [s]."""
    at = page.at or 0.0
    if cause == "episode" or (cause == "play" and at >= end):
        return 0.0
    if cause == "pulse":
        at += step
    return min(at, end)


def _message(session: Session, shown: GrowingEpisode | None) -> str:
    """What goes wrong, in one line; empty where nothing does."""
    if session.problem:
        return escape_unprintable(session.problem)
    if shown is None:
        return "waiting for the first episode"
    if shown.faults:
        return escape_unprintable(shown.faults[-1][1])
    age = session.tail.age
    return f"nothing new for {age:.0f} s" if session.is_live and age > SILENCE_LIMIT else ""


def _serve(server: Any, session: Session, token: str) -> None:
    """Answer what assets/stop.js asks, on ways that no drawing and no lock is in."""
    from flask import request  # noqa: PLC0415 - optional

    own = secrets.token_hex(8)

    def plain(text: str, code: int = 200) -> Any:
        return text, code, {"Content-Type": "text/plain; charset=utf-8"}

    def stop() -> Any:
        shown = request.headers.get(STOP_TOKEN, "")
        if not secrets.compare_digest(shown.encode(), token.encode()):
            return plain("not stopped: only the page's own button may; run acsar-gym estop\n", 403)
        return plain(escape_unprintable(session.stop().said))

    def alive() -> Any:
        return plain(own)

    server.add_url_rule("/stop", "stop", stop, methods=["POST"])
    server.add_url_rule("/alive", "alive", alive)


def _guard(server: Any) -> None:
    """Answer pages from this computer only, and tell browsers to load nothing from elsewhere."""
    from flask import abort, request  # noqa: PLC0415 - optional

    def check() -> None:
        own = f"http://{request.host}"
        is_own = request.headers.get("Origin", own) == own
        if request.host.rsplit(":", 1)[0] not in LOCAL_HOSTS or not is_own:
            abort(403)

    def secured(response: Any) -> Any:
        response.headers["Content-Security-Policy"] = CONTENT_POLICY
        response.headers["X-Frame-Options"] = "DENY"
        return response

    server.before_request(check)
    server.after_request(secured)
