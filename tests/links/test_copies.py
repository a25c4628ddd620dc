"""Copies and pickles of links are made as the first was, with all arguments of its constructor."""

from __future__ import annotations

import copy
import pickle
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from recording_tools import drive

from acsar_gym import RobotConfig, open_link
from acsar_gym.errors import LinkLostError
from acsar_gym.links.faults import FaultyLink
from acsar_gym.links.replay import ReplayLink
from acsar_gym.links.serial import SerialLink
from acsar_gym.protocol import ZERO, encode
from acsar_gym.tools.commission.examine import StoppableLink
from acsar_gym.worlds import Scene

ACSAR = RobotConfig.preset("acsar")
COPIES: dict[str, Callable[[Any], Any]] = {
    "copy": copy.copy,
    "deepcopy": copy.deepcopy,
    "pickle": lambda link: pickle.loads(pickle.dumps(link)),  # noqa: S301
    "a copy's copy": lambda link: copy.deepcopy(pickle.loads(pickle.dumps(link))),  # noqa: S301
}


@pytest.fixture(params=COPIES)
def copied(request: pytest.FixtureRequest) -> Callable[[Any], Any]:
    return COPIES[request.param]


@pytest.mark.parametrize("compare", [True, False])
def test_a_replay_compares_as_the_first_did(
    compare: bool, copied: Callable[[Any], Any], tmp_path: Path
) -> None:
    link = copied(ReplayLink(drive(tmp_path / "a.mcap", ACSAR, 20), compare=compare))
    link.reset(Scene())
    link.write(b"another command")
    if compare:
        with pytest.raises(LinkLostError, match="other commands than recorded"):
            link.advance(0.01)
    else:
        link.advance(0.01)
    link.close()


def test_a_serial_link_stops_with_the_same_zeros(copied: Callable[[Any], Any]) -> None:
    zeros = [encode(ZERO, trailing_comma=comma) for comma in (False, True)]
    link = copied(SerialLink("/dev/acsar-missing", ACSAR, zeros))
    assert link._stop_line == b"\r\n" + b"".join(zeros)
    assert link.watchdog._zeros == link._stop_line
    assert (link.device, link._config) == ("/dev/acsar-missing", ACSAR)


def test_a_link_of_the_doctor_hears_stops_as_well(copied: Callable[[Any], Any]) -> None:
    first = StoppableLink("/dev/acsar-missing", ACSAR)
    link = copied(first)
    assert isinstance(link, StoppableLink)
    assert link._stop_line == first._stop_line
    assert link.listener.paths != first.listener.paths
    for each in (first, link):
        each.close()


def test_a_link_whose_faults_a_generator_draws_begins_anew(copied: Callable[[Any], Any]) -> None:
    generator = np.random.default_rng(3)
    first = FaultyLink(open_link("planar", ACSAR), {"dropped_lines": 0.5}, generator)
    link = copied(first)
    assert link._key == first._key
    assert generator.random() == np.random.default_rng(3).random(2)[1]
