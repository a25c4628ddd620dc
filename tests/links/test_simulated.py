"""The physics of a scene, on all simulated links: what each parameter does to the robot."""

from __future__ import annotations

import time
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest

from acsar_gym import RobotConfig, open_link
from acsar_gym.links.simulated import SimulatedLink
from acsar_gym.physics.randomization import Randomizer
from acsar_gym.protocol import Decoder, Speeds, encode
from acsar_gym.worlds import Scene, World
from acsar_gym.worlds.movers import walk

CONFIG = RobotConfig()
TICK = CONFIG.period
FORWARD: Speeds = (8.0, 8.0, 8.0, 8.0)


@pytest.fixture(params=["planar", "bullet", "mujoco"], scope="module")
def link(request: pytest.FixtureRequest) -> Iterator[SimulatedLink]:
    made = open_link(request.param, CONFIG)
    assert isinstance(made, SimulatedLink)
    made.open()
    yield made
    made.close()


def physics(**values: float) -> Any:
    """A robot that differs from the configured one in these parameters."""
    ranges = {name: (value, value) for name, value in values.items()}
    return Randomizer(ranges, CONFIG, 0.1, simulated=True).draw(np.random.default_rng(0))


def drive(link: SimulatedLink, drawn: Any, seconds: float, speeds: Speeds) -> bytes:
    """The feedback of a drive from rest."""
    link.reset(Scene(physics=drawn))
    answer = b""
    for _ in range(round(seconds / TICK)):
        link.write(encode(speeds))
        answer += link.advance(TICK)
    return answer


def test_work_of_a_straight_drive_is_at_least_its_kinetic_energy(link: SimulatedLink) -> None:
    """Wheels that reach their speed with a lag slip a little, which costs the rest."""
    drive(link, None, 0.1, FORWARD)
    assert link.work == 0.0  # it is measured only where asked
    link.metered = True
    drive(link, None, 1.0, FORWARD)
    kinetic = CONFIG.body.mass * (8.0 * CONFIG.wheel_radius) ** 2 / 2.0
    assert 0.9 * kinetic < link.work < 1.5 * kinetic
    link.reset(Scene())
    link.metered = False
    assert link.work == 0.0


def lines(answer: bytes) -> list[Any]:
    return [reading.speeds for reading in Decoder().feed(answer)]


def test_latency_delays_commands_and_feedback(link: SimulatedLink) -> None:
    """Each by five ticks."""
    late = lines(drive(link, physics(latency=5.0 * TICK), 1.0, FORWARD))
    prompt = lines(drive(link, None, 1.0, FORWARD))
    assert len(late) == len(prompt) - 5
    assert late[5:] == prompt[: len(late) - 5]


def test_physics_is_that_of_the_scene_and_configured_again_in_the_next(link: SimulatedLink) -> None:
    fresh = drive(link, None, 0.5, FORWARD), link.truth
    drawn = physics(motor_lag=3.0, friction=0.3, deadband=1.0, latency=0.03, feedback_rate=25.0)
    answer = drive(link, drawn._replace(blend_a=1.0), 0.5, (8.0, 0.9, 8.0, 8.0))
    assert len(lines(answer)) in (11, 12)
    a, b, c, d = lines(answer)[-1]
    assert a > 1.1 * c > 0.0
    assert c == pytest.approx(d, rel=0.1)
    assert abs(b) < 0.5
    assert (drive(link, None, 0.5, FORWARD), link.truth) == fresh


def test_movers_advance_once_a_control_period_however_time_is_cut(link: SimulatedLink) -> None:
    """An emulated board lets a loop of 5 ms pass at a time, faults several ticks at once."""
    person = walk([[2.0, -1.0], [2.0, 1.0]], 1.0, reacts=True, sees_robot=False)
    walker = walk([[-3.0, 1.0], [3.0, 1.0]], 1.5)
    scene = Scene(world=World(movers=(person, walker)))
    places = []
    for parts, periods in ((2, 1), (1, 1), (1, 5)):
        link.reset(scene)
        for _ in range(100 * parts // periods):
            link.advance(TICK * periods / parts)
        crowd = link.truth.crowd
        assert crowd is not None
        assert crowd.now == pytest.approx(1.0)
        places.append(crowd.states[:, :4].tolist())

    assert places[0] == places[1] == places[2]
    assert places[0][1][:2] == pytest.approx(walker.position(1.0))
    link.reset(Scene())
    assert link.truth.crowd is None


def test_realtime_paces_a_simulated_link() -> None:
    link = open_link("planar", CONFIG, realtime=2.0)
    link.open()
    link.reset(Scene())
    link.advance(TICK)  # compiles
    start = time.monotonic()
    for _ in range(40):
        link.advance(TICK)
    assert time.monotonic() - start > 38 * TICK / 2.0
    link.close()
