"""What runs drive, and the floor that they need."""

from __future__ import annotations

import math

import pytest
from calibration_tools import ACSAR

from acsar_gym.errors import ConfigError
from acsar_gym.tools.sysid import calibration_drive
from acsar_gym.tools.sysid.calibration_drive import (
    RunPlan,
    check_space,
    find_needed_space,
    make_fence,
)

LINES = calibration_drive.plan_straights(2.0, 0.3, 3)


def test_every_second_line_goes_back_and_speeds_differ() -> None:
    assert [plan.back for plan in LINES] == [False, True, False]
    assert len({plan.linear for plan in LINES}) == 3
    assert [plan.ahead().name for plan in LINES] == ["straight 1", "straight 2", "straight 3"]
    assert not any(plan.ahead().back for plan in LINES)


def test_turns_alternate_over_speeds_and_radii() -> None:
    plans = calibration_drive.plan_turns(5.0, (0.5, 1.0), (0.0, 0.3), 2)
    angles = [leg.angle for plan in plans for leg in plan.legs]
    assert len(plans) == 8
    assert [math.copysign(1.0, angle) for angle in angles] == [1.0, -1.0] * 4
    assert {abs(angle) for angle in angles} == {10.0 * math.pi}
    assert plans[1].legs[0].distance == pytest.approx(3.0 * math.pi)
    assert plans[1].linear == pytest.approx(0.15)


def test_squares_come_clockwise_first() -> None:
    plans = calibration_drive.plan_squares(1.0, 0.3, 1.0, 1, 2)
    assert [plan.name for plan in plans] == ["square cw 1", "square ccw 1", "square ccw 2"]
    assert sum(leg.angle for leg in plans[0].legs) == pytest.approx(-2.0 * math.pi)


@pytest.mark.parametrize(
    ("plans", "ahead", "aside"),
    [
        (LINES, 2.0, 0.0),
        (calibration_drive.plan_turns(2.0, (0.5,), (0.0,), 1), 0.0, 0.0),
        (calibration_drive.plan_turns(2.0, (0.5,), (0.5,), 2), 0.5, 1.0),
        (calibration_drive.plan_squares(1.0, 0.3, 1.0, 1, 0), 1.0, 1.0),
    ],
)
def test_the_floor_holds_path_robot_and_slack(
    plans: list[RunPlan], ahead: float, aside: float
) -> None:
    x, y = find_needed_space(plans, ACSAR)
    own = find_needed_space(calibration_drive.plan_turns(1.0, (0.5,), (0.0,), 1), ACSAR)[0]
    slack = calibration_drive.SPACE_SLACK * max(ahead, aside)
    assert (x, y) == pytest.approx((ahead + slack + own, aside + slack + own), abs=1e-3)


def test_a_space_that_is_too_small_says_how_much_is_needed() -> None:
    with pytest.raises(ConfigError, match=r"--space 2 1: too small: this needs 2\.\d\d m ahead"):
        check_space(ACSAR, LINES, (2.0, 1.0))
    assert check_space(ACSAR, LINES, (4.0, 1.0)) == (4.0, 1.0)
    assert check_space(ACSAR, LINES, None) == find_needed_space(LINES, ACSAR)


def test_the_fence_is_around_the_space_also_on_the_way_back() -> None:
    ahead, back = (make_fence(ACSAR, plan, (4.0, 1.5)) for plan in LINES[:2])
    assert ahead.max_x == -back.min_x > 3.5
    assert ahead.min_x == -back.max_x > -1.5
    assert ahead.max_y == -ahead.min_y < 1.5


@pytest.mark.parametrize(
    ("make", "said"),
    [
        (lambda: calibration_drive.plan_straights(0.0, 0.3, 1), "--distance 0: must be"),
        (lambda: calibration_drive.plan_straights(math.nan, 0.3, 1), "--distance nan"),
        (lambda: calibration_drive.plan_straights(2.0, 0.3, 0), "0 runs: must be 1 to"),
        (lambda: calibration_drive.plan_turns(-1.0, (1.0,), (0.0,), 1), "--turns -1"),
        (lambda: calibration_drive.plan_turns(1.0, (1.0,), (-0.3,), 1), "--radii -0.3"),
        (lambda: calibration_drive.plan_squares(1.0, 0.3, 1.0, 500, 0), "500 runs"),
    ],
)
def test_bad_sizes_are_told(make: object, said: str) -> None:
    assert callable(make)
    with pytest.raises(ConfigError, match=said):
        make()
