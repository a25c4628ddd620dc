"""Two runs over each other: which episodes belong together, and the gap between them."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from recording_tools import drive

from acsar_gym import RobotConfig
from acsar_gym.errors import ConfigError
from acsar_gym.tools.view.app import make_app
from acsar_gym.tools.view.drawing import COLOURS, describe_gap
from acsar_gym.tools.view.overlay import Overlay, Partner, list_keys, measure_gaps
from acsar_gym.tools.view.session import Session
from acsar_gym.tools.view.tail import TICK_PLACES, GrowingEpisode, RecordingTail


@pytest.fixture(scope="module")
def other(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The tape's drive, but shorter, by a robot with larger wheels."""
    config = RobotConfig.of(None).model_copy(update={"wheel_radius": 0.06})
    return drive(tmp_path_factory.mktemp("other") / "other.mcap", config, ticks=90)


def episodes_of(tape: Path, *infos: dict[str, Any]) -> list[GrowingEpisode]:
    found = []
    for info in infos:
        (episode,) = RecordingTail(tape).episodes
        episode.info = info
        found.append(episode)
    return found


def test_episodes_are_paired_by_seed_and_which_one_with_it(tape: Path) -> None:
    infos: list[dict[str, Any]] = [{"seed": 3}, {"seed": 4}, {"seed": 3}, {}, {"seed": [1]}]
    assert list_keys(episodes_of(tape, *infos)) == [(3, 0), (4, 0), (3, 1), (None, 0), (None, 1)]


@pytest.mark.parametrize(
    ("own", "theirs", "message"),
    [
        ({"seed": 3, "goal": [1.0, 2.0]}, {"seed": 3, "goal": [1.0, 2.0]}, ""),
        ({"seed": 3, "goal": [1.0, 2.0]}, {"seed": 3}, ""),
        ({}, {}, ""),
        ({"seed": 3}, {"seed": 4}, "other.mcap: has no seed 3: record both with the same seeds"),
        ({}, {"seed": 4}, "other.mcap: has no episode 1 without a seed: "),
        (
            {"seed": 3, "goal": [1.0, 2.0]},
            {"seed": 3, "goal": [1.0, 2.1]},
            "other.mcap: seed 3 has another goal: ",
        ),
    ],
)
def test_what_cannot_be_paired_is_a_line(
    tape: Path,
    other: Path,
    own: dict[str, Any],
    theirs: dict[str, Any],
    message: str,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    beside = RecordingTail(other)
    beside.episodes[0].info = theirs
    monkeypatch.setattr("acsar_gym.tools.view.overlay.RecordingTail", lambda path: beside)
    overlay, mine = Overlay(other), episodes_of(tape, own)
    if not message:
        assert overlay.find_partner(mine, 0).episode is beside.episodes[0]
        return
    with pytest.raises(ConfigError) as error:
        overlay.find_partner(mine, 0)
    assert str(error.value).startswith(message)
    assert "\n" not in str(error.value)


def test_recordings_without_a_pair_are_refused_and_others_say_what_is_alone(
    tape: Path, other: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    session = Session(tape, other)
    assert session.explain_alone(0) == ""
    session.tail.episodes += episodes_of(tape, {"seed": 9})
    assert session.explain_alone(1).startswith("other.mcap: has no seed 9")
    assert session.draw(1, 0.5)[1]["gap"] == ""
    alone = RecordingTail(tape)
    alone.episodes[0].info = {"seed": 9}
    monkeypatch.setattr("acsar_gym.tools.view.session.RecordingTail", lambda path: alone)
    with pytest.raises(ConfigError, match="has no seed 9"):
        Session(tape, other)


def test_the_gap_is_that_of_the_same_time_since_the_first_tick(tape: Path) -> None:
    one, later = episodes_of(tape, {}, {})
    x, y, theta, stamp = (TICK_PLACES[name] for name in ("x", "y", "theta", "stamp"))
    later.ticks.rows[:, stamp] += 0.5  # it has waited for standstill
    later.ticks.rows[:, x] += 0.3
    later.ticks.rows[:, y] -= 0.4
    later.ticks.rows[:, theta] += math.tau + math.radians(-10.0)
    times = np.array([-1.0, 0.0, 0.333, 1.0, 7.0])
    gaps = measure_gaps(one, Partner(later, RobotConfig.of(None), 0.5), times)
    assert np.allclose(gaps, (0.5, math.radians(10.0)))


def test_what_is_drawn_over_the_run_is_in_every_picture(tape: Path, other: Path) -> None:
    session = Session(tape, other)
    figures, texts = session.draw(0, 1.0)
    names = {trace["name"] for trace in figures["top"]["data"]}
    assert {"other path", "other true path", "other robot", "gap", "path", "robot"} <= names
    colours = [trace["line"]["color"] for trace in figures["wheels"]["data"]]
    assert colours.count(COLOURS["other"]) == 4
    own, partner = session.tail.episodes[0], session.find_partner(0)
    assert partner is not None
    assert partner.shift == 0.0
    ends = [one.pose(1.0)[:2] for one in (own, partner.episode)]
    apart = math.dist(*ends) * 100.0
    assert apart > 0.5
    assert texts["gap"].startswith(f"{apart:.1f} cm, ")
    assert "by odometry (at most " in texts["gap"]
    assert "; true: " in texts["gap"]
    session.tail.episodes[0].truth.rows[:, 1:] = np.nan
    assert "true" not in describe_gap(own, partner, 1.0)
    page = make_app(session).server.test_client()
    layout = page.get("/_dash-layout", base_url="http://127.0.0.1:8050").get_data(as_text=True)
    assert "Gap to other.mcap: " in layout
