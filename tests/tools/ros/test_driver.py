"""What the driver's node does without ROS: refuses commands, and reads scenes."""

from __future__ import annotations

import math
import threading
import time

import numpy as np
import pytest

from acsar_gym.errors import ConfigError
from acsar_gym.links.ros2 import format_scene
from acsar_gym.tools.ros.driver import (
    CommandInbox,
    LatenessMeter,
    PublisherNumbers,
    parse_scene,
)
from acsar_gym.worlds import Scene, World

TIMEOUT = 0.2
FORWARD = (0.2, 0.0, 0.0, 0.0, 0.0, 0.5)
STANDING = (0.0,) * 6


@pytest.fixture
def lines() -> list[str]:
    """What the inbox reports."""
    return []


@pytest.fixture
def inbox(lines: list[str]) -> CommandInbox:
    return CommandInbox(TIMEOUT, "base_link", lines.append)


def test_the_newest_twist_counts_until_the_time_out(inbox: CommandInbox, lines: list[str]) -> None:
    assert inbox.current() == (0.0, 0.0)
    inbox.take(FORWARD, "me", age=0.1, frame="base_link")
    assert inbox.current() == (0.2, 0.5)
    time.sleep(1.2 * TIMEOUT)
    assert inbox.current() == (0.0, 0.0)
    assert not lines


@pytest.mark.parametrize(
    ("velocities", "age", "frame", "words"),
    [
        *[
            ((*FORWARD[:place], value, *FORWARD[place + 1 :]), 0.0, "", "isn't finite")
            for place in range(6)
            for value in (math.nan, math.inf, -math.inf)
        ],
        (FORWARD, 0.0, "map", "'map', not 'base_link'"),
        (FORWARD, 0.3, "", "0.30 s old; do the clocks agree?"),
        (FORWARD, -0.3, "", "0.30 s ahead"),
        (FORWARD, math.nan, "", "nan s ahead"),
    ],
)
def test_bad_twists_stop_the_robot_with_one_line(
    velocities: tuple[float, ...],
    age: float,
    frame: str,
    words: str,
    inbox: CommandInbox,
    lines: list[str],
) -> None:
    inbox.take(FORWARD, "me")
    for _ in range(3):
        inbox.take(velocities, "me", age, frame)
        assert inbox.current() == (0.0, 0.0)
    assert len(lines) == 1
    assert lines[0].startswith("cmd_vel: refused ")
    assert words in lines[0]
    assert inbox.problem == lines[0]
    inbox.take(FORWARD, "me")
    assert inbox.current() == (0.2, 0.5)
    assert not inbox.problem


def test_bad_twists_among_good_ones_are_not_reported_again_and_again(
    inbox: CommandInbox, lines: list[str]
) -> None:
    for _ in range(5):
        inbox.take(FORWARD, "me")
        inbox.take((math.nan,) * 6, "me")
        inbox.take(FORWARD, "me", age=0.3)
    assert len(lines) == 2


def test_frames_may_begin_with_a_slash_or_be_left_out(inbox: CommandInbox) -> None:
    for frame in ("", "/base_link", "base_link"):
        inbox.take(STANDING, "me")
        inbox.take(FORWARD, "me", frame=frame)
        assert inbox.current() == (0.2, 0.5)


def test_two_publishers_that_drive_are_refused_until_one_ends(
    inbox: CommandInbox, lines: list[str]
) -> None:
    for _ in range(3):
        inbox.take(FORWARD, "me")
        inbox.take((-0.2, 0.0, 0.0, 0.0, 0.0, 0.0), "you")
        assert inbox.current() == (0.0, 0.0)
    inbox.take(FORWARD, "me")
    assert inbox.current() == (0.0, 0.0)
    assert len(lines) == 1
    assert "two publishers" in lines[0]
    time.sleep(1.2 * TIMEOUT)
    inbox.take(FORWARD, "me")
    assert inbox.current() == (0.2, 0.5)


def test_who_stops_hands_over_and_may_stop_others(inbox: CommandInbox, lines: list[str]) -> None:
    inbox.take(FORWARD, "me")
    inbox.take(STANDING, "you")
    assert inbox.current() == (0.0, 0.0)
    inbox.take(FORWARD, "me")
    inbox.take(STANDING, "me")
    inbox.take(FORWARD, "you")
    assert inbox.current() == (0.2, 0.5)
    assert not lines


def test_two_threads_may_take_at_once(inbox: CommandInbox, lines: list[str]) -> None:
    def take(name: str) -> None:
        for number in range(2000):
            inbox.take(FORWARD, f"{name}{number}")

    threads = [threading.Thread(target=take, args=(name,)) for name in "ab"]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert inbox.current() == (0.0, 0.0)
    assert len(lines) == 1


def test_publishers_are_told_apart_by_their_sequence_numbers() -> None:
    numbers = PublisherNumbers(TIMEOUT)
    one = [numbers.find(sequence) for sequence in (7, 8, 9, 12)]
    assert len({*one}) == 1
    found = [numbers.find(sequence) for sequence in (1, 13, 2, 14, 3, 15)]
    assert found[1::2] == [one[0]] * 3
    assert {*found[::2]}.isdisjoint(one)
    assert len({*found[::2]}) == 1
    time.sleep(1.2 * TIMEOUT)
    assert numbers.find(16) not in found


def test_scenes_go_through_the_parameter_and_back() -> None:
    assert parse_scene(" ") == Scene()
    scene = Scene((1.0, -2.0, 0.5), (3.0, 4.0))
    assert parse_scene(format_scene(scene)) == scene
    world = World(np.array([[1.0, 2.0, 0.3]]), np.array([[0.0, 0.0, 4.0, 0.0]]))
    read = parse_scene(format_scene(Scene((1.0, -2.0, 0.5), (3.0, 4.0), world)))
    assert read.world is not None
    assert np.array_equal(read.world.circles, world.circles)
    assert np.array_equal(read.world.segments, world.segments)
    assert parse_scene('{"goal": [1, 2]}') == Scene(goal=(1.0, 2.0))


@pytest.mark.parametrize(
    "text",
    [
        "nonsense",
        "[1, 2]",
        "3",
        "null",
        '{"start": [1, 2]}',
        '{"start": "abc"}',
        '{"start": [1, 2, NaN]}',
        '{"goal": [1]}',
        '{"goal": [1, Infinity]}',
        '{"goal": 3}',
        '{"strat": [1, 2, 3]}',
        '{"world": "no such world"}',
        '{"world": {"shapes": 3}}',
        '{"world": 3}',
    ],
)
def test_bad_scenes_are_refused_with_one_line(text: str) -> None:
    with pytest.raises(ConfigError) as refused:
        parse_scene(text)
    assert "\n" not in str(refused.value)


def test_late_messages_are_told_from_clocks_that_differ() -> None:
    meter, ahead = LatenessMeter(), 7_000_000_000  # of the sender's clock [ns]
    sent = [round(number * 5e7) for number in range(400)]
    delays = [1_000_000 + 500_000 * (number % 3) for number in range(400)]
    told = [meter.find("me", s + ahead, s + d) for s, d in zip(sent, delays, strict=True)]
    assert max(told) <= 0.001
    # A middleware that hung hands over a second's messages at once.
    burst = [meter.find("me", sent[-1] + ahead + late, sent[-1] + 10**9) for late in (0, 10**8)]
    assert burst == pytest.approx([1.0, 0.9], abs=0.002)
    assert meter.find("another", 0, 10**9) == 0.0


def test_a_clock_that_was_set_is_believed_after_a_while() -> None:
    meter = LatenessMeter()
    told = [
        meter.find("me", k * 10**8, k * 10**8 + (3 * 10**9 if k > 50 else 0)) for k in range(300)
    ]
    assert told[60] == 3.0
    assert told[-1] == 0.0
