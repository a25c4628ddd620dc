"""Rate and jitter of feedback lines, however late and in bursts a host read them."""

from __future__ import annotations

import numpy as np
import pytest

from acsar_gym import RobotConfig
from acsar_gym.protocol import encode
from acsar_gym.recording.types import WireLog
from acsar_gym.tools.sysid import feedback_lines, tracks
from acsar_gym.tools.sysid.tracks import BoardTrack


def track(stamps: np.ndarray[tuple[int], np.dtype[np.float64]]) -> BoardTrack:
    count = len(stamps)
    return BoardTrack(
        arrivals=np.zeros(1),
        commands=np.zeros((1, 4)),
        stamps=stamps,
        speeds=np.zeros((count, 4)),
        held_out=np.zeros(count, bool),
        numbers=np.arange(count),
    )


def test_regular_lines() -> None:
    found = feedback_lines.measure_line_rate([track(np.arange(200) / 50.0)])
    assert found.rate == pytest.approx(50.0)
    assert found.jitter == pytest.approx(0.0, abs=1e-9)


@pytest.mark.parametrize("stalled", [0.1, 0.4])
def test_a_stalled_host_reads_in_bursts(stalled: float) -> None:
    made = np.arange(1000) / 50.0
    read = made.copy()
    for begin in np.arange(1.0, 19.0, 1.5):  # nothing is read, then all at once
        late = (made >= begin) & (made < begin + stalled)
        read[late] = begin + stalled + 1e-4 * np.arange(np.count_nonzero(late))
    found = feedback_lines.measure_line_rate([track(read)])
    assert found.rate == pytest.approx(50.0, rel=0.002)


def test_lines_that_a_fit_leaves_out_as_late_still_count() -> None:
    made = np.arange(2000) / 100.0
    read = made + 0.0003 * np.random.default_rng(0).random(2000)
    read[::30] += 0.0067
    said = (encode((1.0, 1.0, 1.0, 1.0)),) * 2000
    log = WireLog(made, said, read, said)
    one = tracks.decode_track(log, RobotConfig.preset("acsar"))
    assert one is not None
    assert len(one.stamps) < 1960
    assert feedback_lines.measure_line_rate([one]).rate == pytest.approx(100.0, abs=0.1)


def test_lost_lines() -> None:
    kept = np.random.default_rng(0).random(1000) > 0.002
    found = feedback_lines.measure_line_rate([track((np.arange(1000) / 50.0)[kept])])
    assert abs(found.rate - 50.0) < 0.2


def test_episodes_count_by_their_length() -> None:
    found = feedback_lines.measure_line_rate(
        [track(np.arange(1000) / 100.0), track(np.arange(100) / 98.0)]
    )
    assert found.rate == pytest.approx(99.8, abs=0.1)
