"""The PyBullet robot against the closed forms, at the default substep."""

from __future__ import annotations

import gc
import math
from collections.abc import Iterator

import psutil
import pytest

from acsar_gym.config import RobotConfig
from acsar_gym.errors import RenderError
from acsar_gym.physics.bullet import BulletBody
from acsar_gym.physics.model import closed_form_yaw_rate
from acsar_gym.protocol import ZERO, Speeds
from acsar_gym.worlds import Scene

GEOMETRIES = [(0.05, 0.30, 0.22), (0.05, 0.30, 0.30), (0.0825, 0.545, 0.512)]
TURNS: list[Speeds] = [(4.0, -4.0, -4.0, 4.0), (8.0, 4.0, 4.0, 8.0), (3.0, 7.0, 7.0, 3.0)]
HEADINGS = [math.pi / 4 * k + 0.1 for k in range(8)]
SECOND = 200


@pytest.fixture
def body() -> Iterator[BulletBody]:
    made = BulletBody(RobotConfig())
    yield made
    made.close()


def steps(body: BulletBody, set_points: Speeds, count: int) -> None:
    for _ in range(count):
        body.step(set_points)


def mean_yaw_rate(body: BulletBody, turn: Speeds, heading: float) -> float:
    body.reset(Scene(start=(1.0, -2.0, heading)))
    steps(body, turn, 2 * SECOND)
    before = body.truth.pose[2]
    steps(body, turn, SECOND)
    return math.remainder(body.truth.pose[2] - before, 2.0 * math.pi)


@pytest.mark.parametrize("geometry", GEOMETRIES)
@pytest.mark.parametrize("turn", TURNS)
def test_steady_turns_are_the_closed_form_at_every_heading(
    geometry: tuple[float, float, float], turn: Speeds
) -> None:
    radius, separation, wheelbase = geometry
    config = RobotConfig(wheel_radius=radius, wheel_separation=separation, wheelbase=wheelbase)
    body = BulletBody(config)
    rates = [mean_yaw_rate(body, turn, heading) for heading in HEADINGS]
    body.close()
    expected = closed_form_yaw_rate(turn, config)
    assert rates == pytest.approx([expected] * len(HEADINGS), rel=0.01)
    assert max(rates) - min(rates) < 0.005 * abs(expected)


@pytest.mark.parametrize("heading", HEADINGS)
def test_a_straight_drive_of_ten_metres_stays_straight(body: BulletBody, heading: float) -> None:
    body.reset(Scene(start=(0.0, 0.0, heading)))
    steps(body, (10.0, 10.0, 10.0, 10.0), 21 * SECOND)
    x, y, _ = body.truth.pose
    along = x * math.cos(heading) + y * math.sin(heading)
    sideways = y * math.cos(heading) - x * math.sin(heading)
    assert along > 10.0
    assert abs(sideways) < 0.01


@pytest.mark.parametrize("turn", TURNS)
def test_after_a_stop_from_a_turn_nothing_rotates(body: BulletBody, turn: Speeds) -> None:
    steps(body, turn, 2 * SECOND)
    while body.wheel_speeds != ZERO:
        body.step(ZERO)
    steps(body, ZERO, 2)
    stood = body.truth.pose
    steps(body, ZERO, 5 * SECOND)
    assert body.truth.pose == pytest.approx(stood, abs=1e-6)
    assert body.truth.twist == pytest.approx((0.0, 0.0), abs=1e-6)


def drive_some(body: BulletBody) -> list[tuple[float, float, float]]:
    poses = []
    for turn in (*TURNS, ZERO):
        for _ in range(50):
            body.step(turn)
            poses.append(body.truth.pose)
    return poses


def test_a_reset_body_repeats_a_fresh_one_bit_for_bit(body: BulletBody) -> None:
    start = Scene(start=(0.3, 0.1, 1.0))
    body.reset(start)
    fresh = drive_some(body)
    body.reset(Scene(start=(-5.0, 2.0, -2.0)))
    steps(body, (9.0, 2.0, 2.0, 9.0), 333)
    body.reset(start)
    assert drive_some(body) == fresh


def test_two_bodies_share_nothing(body: BulletBody) -> None:
    other = BulletBody(RobotConfig())
    steps(other, (10.0, 10.0, 10.0, 10.0), SECOND)
    other.close()
    assert body.truth.pose == (0.0, 0.0, 0.0)


def test_memory_is_flat_over_a_thousand_resets(body: BulletBody) -> None:
    process = psutil.Process()

    def some_resets(count: int) -> int:
        for _ in range(count):
            body.reset(Scene(goal=(1.0, 1.0)))
            steps(body, TURNS[0], 5)
        gc.collect()
        return int(process.memory_info().rss)

    before = some_resets(200)
    assert some_resets(1000) - before < 1_000_000


def test_the_picture_shows_robot_and_goal(body: BulletBody) -> None:
    empty = body.image(160, 120)
    body.reset(Scene(goal=(0.5, 0.0)))
    marked = body.image(160, 120)
    assert empty is not None
    assert marked is not None
    assert marked.shape == (120, 160, 3)
    assert marked.std() > 5.0
    assert (empty != marked).any()


def test_a_window_without_a_display_says_what_to_use(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("DISPLAY", raising=False)
    with pytest.raises(RenderError, match="needs a display; drive without a window"):
        BulletBody(RobotConfig(), window=True)


def test_closing_twice_is_once() -> None:
    body = BulletBody(RobotConfig())
    body.close()
    body.close()
