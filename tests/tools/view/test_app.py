"""The page by a test client: what it shows, and what it answers."""

from __future__ import annotations

import json
import os
import re
from pathlib import Path
from typing import Any

import pytest
from dash import no_update
from recording_tools import begun

from acsar_gym.tools.view import app as apps
from acsar_gym.tools.view.app import (
    PAGE_INPUTS,
    PAGE_OUTPUTS,
    QUICK_UPDATE,
    SLOW_UPDATE,
    PageInputs,
    update_page,
)
from acsar_gym.tools.view.drawing import COLOURS
from acsar_gym.tools.view.session import Session
from acsar_gym.tools.view.tail import WRITING_TIMEOUT

BASE = "http://127.0.0.1:8050"
OPENED = PageInputs(
    pulse=None,
    at=0.0,
    play=0,
    episode=None,
    playing=False,
    clock=0.0,
    seen=1,
    run=0,
    longest=1.0,
    rate="1",
)


@pytest.fixture(scope="module")
def session(tape: Path) -> Session:
    return Session(tape)


@pytest.fixture(scope="module")
def client(session: Session) -> Any:
    return apps.make_app(session).server.test_client()


def test_everything_comes_from_this_server(client: Any) -> None:
    answer = client.get("/", base_url=BASE)
    html = answer.get_data(as_text=True)
    links = re.findall(r'(?:src|href)="([^"]+)"', html)
    assert len(links) > 5
    assert all(link.startswith("/") for link in links)
    assert "default-src 'self'" in answer.headers["Content-Security-Policy"]
    style = next(link for link in links if "dashboard.css" in link)
    with client.get(style, base_url=BASE) as css:
        assert css.status_code == 200
        assert b"http" not in css.data


@pytest.mark.parametrize(
    ("base", "origin", "code"),
    [
        (BASE, None, 200),
        (BASE, BASE, 200),
        ("http://localhost:8050", None, 200),
        ("http://example.com", None, 403),
        ("http://127.0.0.1.example.com:8050", None, 403),
        (BASE, "http://example.com", 403),
    ],
)
def test_other_sites_get_nothing(client: Any, base: str, origin: str | None, code: int) -> None:
    headers = {"Origin": origin} if origin else {}
    assert client.get("/", base_url=base, headers=headers).status_code == code


def test_the_page_is_answered_over_http(client: Any) -> None:
    asked = client.get("/_dash-dependencies", base_url=BASE).get_json()[0]
    values = {"time": 0.5, "episode": 1, "playing": False, "clock": 1.0, "seen": 0, "rate": "1"}
    values["run"] = 0
    body = {
        "output": asked["output"],
        "outputs": [
            {"id": one.component_id, "property": one.component_property}
            for one in PAGE_OUTPUTS.values()
        ],
        "inputs": [{**one, "value": values.get(one["id"])} for one in asked["inputs"]],
        "state": [
            {**one, "value": 1.0 if one["property"] == "max" else values.get(one["id"])}
            for one in asked["state"]
        ],
        "changedPropIds": ["time.value"],
    }
    assert len(body["inputs"]) + len(body["state"]) == len(PAGE_INPUTS)
    answer = client.post("/_dash-update-component", json=body, base_url=BASE)
    told = answer.get_json()["response"]
    assert told["value-time"]["children"] == "0.5"
    assert told["state"]["children"] == "recorded"
    assert len(told["top"]["figure"]["data"]) > 6
    assert len(told["lateness"]["figure"]["data"]) == 3
    assert set(told) == {one.component_id for one in PAGE_OUTPUTS.values()}
    assert len(answer.data) < 200_000


def test_a_recording_is_opened_at_its_beginning_and_has_no_stop_button(session: Session) -> None:
    told = answered(session, None)
    assert (told["state"], told["play"], told["slider"]) == ("recorded", "Play", 0.0)
    assert told["box"] == "stopping none"
    assert told["longest"] == pytest.approx(session.tail.episodes[0].end)
    assert told["pulse"] == SLOW_UPDATE
    assert told["message"] == ""
    dragged = answered(session, "time", at=0.6)
    assert (dragged["slider"], dragged["time"]) == (0.6, "0.6")
    assert dragged["linear_asked"] == "0.30"
    assert dragged["late"] == "\N{EN DASH}"  # simulated


def test_playing_moves_on_by_the_time_that_has_passed(session: Session) -> None:
    assert answered(session, "play")["playing"]
    told = answered(session, "pulse", playing=True, clock=99.8, rate="4", at=0.1)
    assert told["slider"] == pytest.approx(0.9)
    assert (told["pulse"], told["play"]) == (QUICK_UPDATE, "Pause")
    over = answered(session, "pulse", playing=True, clock=0.0, rate="16", at=1.0)
    assert not over["playing"]
    assert over["slider"] == over["longest"]
    again = answered(session, "play", at=over["longest"])
    assert (again["slider"], again["playing"]) == (0.0, True)


def test_a_live_run_is_followed_until_somebody_looks_back(tape: Path, tmp_path: Path) -> None:
    path = tmp_path / "live.mcap"
    path.write_bytes(begun(tape))
    live = Session(path)
    told = answered(live, None, playing=True)
    assert (told["state"], told["slider"]) == ("live", told["longest"])
    past = answered(live, "time", playing=True, at=0.2)
    assert (past["slider"], past["playing"], past["play"]) == (0.2, False, "Follow")
    assert answered(live, "pulse", playing=False, at=0.2)["pulse"] == QUICK_UPDATE
    assert answered(live, "play", playing=False, at=0.2)["slider"] == told["longest"]
    assert answered(live, "pulse", playing=True)["top"] is no_update
    path.write_bytes(tape.read_bytes())
    before = {"at": told["slider"], "longest": told["longest"], "clock": 99.9}
    for _ in range(2):  # two tabs
        over = answered(live, "pulse", playing=True, **before)
        assert over["slider"] == over["longest"] > told["longest"]
        assert (over["state"], over["playing"]) == ("ended", False)
        assert over["top"] is not no_update
    assert answered(live, "pulse", seen=live.revision)["top"] is no_update


def test_a_run_that_replaces_what_was_watched_is_followed(tape: Path, tmp_path: Path) -> None:
    path = tmp_path / "drive.mcap"
    path.write_bytes(tape.read_bytes())
    page = Session(path)
    watched = answered(page, "time", at=0.2)
    path.rename(tmp_path / "drive.1.mcap")
    path.write_bytes(tape.read_bytes()[:300])  # its header isn't there yet
    broken = answered(page, "pulse", at=0.2, run=watched["run"])
    path.write_bytes(begun(tape))
    told = answered(page, "pulse", at=broken["slider"], run=broken["run"])
    assert (told["state"], told["playing"]) == ("live", True)
    assert told["slider"] == told["longest"] > 0.2
    past = answered(page, "time", playing=True, at=0.2, run=told["run"])
    still = answered(page, "pulse", at=0.2, run=past["run"], seen=past["seen"])
    assert (still["playing"], still["slider"]) == (False, no_update)
    path.rename(tmp_path / "drive.2.mcap")  # another one, which is over before anybody asks
    path.write_bytes(tape.read_bytes())
    over = answered(page, "pulse", at=0.2, run=past["run"], seen=past["seen"])
    assert (over["playing"], over["slider"]) == (False, over["longest"])


def test_a_recording_that_goes_on_is_followed(tape: Path, tmp_path: Path) -> None:
    path = tmp_path / "drive.mcap"
    path.write_bytes(begun(tape))
    long_ago = path.stat().st_mtime - 2.0 * WRITING_TIMEOUT
    os.utime(path, (long_ago, long_ago))
    page = Session(path)
    assert answered(page, None)["state"] == "recorded"
    os.utime(path)
    told = answered(page, "pulse")
    assert (told["state"], told["playing"], told["slider"]) == ("live", True, told["longest"])


def answered(session: Session, cause: str | None, now: float = 100.0, **changes: Any) -> Any:
    return update_page(session, PageInputs(**(vars(OPENED) | changes)), cause, now)


def test_unknown_episodes_show_a_known_one(session: Session) -> None:
    for number in (None, -3, 0, 7):
        assert answered(session, "episode", episode=number)["episode"] == 1


def test_what_went_wrong_is_told_of_the_episode_that_is_shown(tape: Path) -> None:
    several = Session(tape)
    several.tail.episodes += Session(tape).tail.episodes
    several.tail.episodes[1].faults.append((1.0, "the board is silent"))
    assert answered(several, "episode", episode=1)["message"] == ""
    assert answered(several, "episode", episode=2)["message"] == "the board is silent"


def test_the_stop_button_asks_past_dash(client: Any) -> None:
    page = client.get("/", base_url=BASE).get_data(as_text=True)
    mark = re.findall('<meta name="stop-token" content="([^"]{40,})">', page)[0]
    for headers in ({"Origin": BASE}, {}):
        asked = {"stop-token": mark, **headers}
        answer = client.post("/stop", base_url=BASE, headers=asked)
        assert answer.get_data(as_text=True).startswith("nothing to stop")
    elsewhere = {"stop-token": mark, "Origin": "http://example.com"}
    assert client.post("/stop", base_url=BASE, headers=elsewhere).status_code == 403
    one, two = (client.get("/alive", base_url=BASE).data for _ in range(2))
    assert one == two != b""


def test_a_stop_that_is_not_of_the_page_is_refused(
    session: Session, client: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delattr(Session, "stop")
    other = (
        apps.make_app(session).server.test_client().get("/", base_url=BASE).get_data(as_text=True)
    )
    (of_another_start,) = re.findall('<meta name="stop-token" content="([^"]+)">', other)
    for mark in (None, "", "x" * 43, "\xe9" * 43, of_another_start):
        headers = {} if mark is None else {"stop-token": mark}
        answer = client.post("/stop", base_url=BASE, headers=headers)
        assert (answer.status_code, answer.data.count(b"\n")) == (403, 1)
        assert answer.data.startswith(b"not stopped: ")


@pytest.mark.parametrize("name", ["<img src=x onerror=alert(1)>.mcap", os.fsdecode(b"\xff.mcap")])
def test_any_file_name_is_only_text(tape: Path, tmp_path: Path, name: str) -> None:
    path = tmp_path / name
    path.write_bytes(tape.read_bytes())
    odd = apps.make_app(Session(path)).server.test_client()
    html = odd.get("/", base_url=BASE).get_data(as_text=True)
    assert "<img" not in html
    assert odd.get("/_dash-layout", base_url=BASE).status_code == 200


def test_figures_hold_what_their_keys_name(session: Session) -> None:
    figures, _ = session.draw(0, session.tail.episodes[0].end)
    names = [trace["name"] for trace in figures["top"]["data"]]
    assert {"path", "true path", "robot", "start", "LiDAR now"} <= set(names)
    wheels = figures["wheels"]["data"]
    assert len(wheels) == 12
    drawn = {one["line"]["color"] for one in wheels}
    assert drawn == {COLOURS[name] for name in ("asked", "sent", "measured")}
    css = (apps.ASSETS / "dashboard.css").read_text(encoding="utf-8")
    for name in ("asked", "sent", "measured", "goal", "scan", "seen", "truth"):
        assert f"--{name}: {COLOURS[name]};" in css
    json.dumps(figures)
