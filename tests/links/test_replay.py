"""The proof that the wire is the seam: a PyBullet episode's bytes, played back over a real tty."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
import serial
from tapes import playing

from acsar_gym import open_link
from acsar_gym.errors import ConfigError, LinkLostError
from acsar_gym.links.recording import RecordingLink
from acsar_gym.links.replay import ReplayLink

ENV_ID = "acsar_gym/PointGoal-v0"
EPISODES = 2
STEPS = 60


def rollout(link: Any) -> list[bytes]:
    """Observations of two episodes with fixed actions, as bytes."""
    env = gymnasium.make(ENV_ID, link=link)
    rng = np.random.default_rng(11)
    seen = []
    for seed in range(EPISODES):
        seen.append(env.reset(seed=seed)[0].tobytes())
        for _ in range(STEPS):
            action = rng.uniform(-1.0, 1.0, 2).astype(np.float32)
            observation, reward, terminated, _, _ = env.step(action)
            seen.append(observation.tobytes() + np.float64(reward).tobytes())
            assert not terminated
    env.close()
    return seen


@pytest.fixture(scope="module")
def taped(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, list[bytes]]:
    tape = tmp_path_factory.mktemp("tape") / "bullet.jsonl"
    return tape, rollout(RecordingLink(open_link("bullet"), tape))


@pytest.fixture
def tty_playing(taped: tuple[Path, list[bytes]]) -> Iterator[tuple[serial.Serial, Any]]:
    with playing(taped[0]) as port_and_heard:
        yield port_and_heard


def test_a_recording_replays_bit_for_bit(taped: tuple[Path, list[bytes]]) -> None:
    tape, seen = taped
    assert rollout(f"replay:{tape}") == seen


def test_over_a_real_tty_the_observations_are_the_same_bits(
    taped: tuple[Path, list[bytes]], tty_playing: tuple[serial.Serial, Any]
) -> None:
    tape, seen = taped
    port, heard = tty_playing
    assert rollout(ReplayLink(tape, port)) == seen
    assert heard.get(timeout=5.0) == 0  # and the commands are the same bytes, too


def test_another_recording_gives_other_observations(
    taped: tuple[Path, list[bytes]], tmp_path: Path
) -> None:
    tape, seen = taped
    changed = tmp_path / "changed.jsonl"
    changed.write_text(tape.read_text().replace("ap0", "an0"))
    assert rollout(f"replay:{changed}") != seen


def test_the_end_of_a_recording_is_an_error(taped: tuple[Path, list[bytes]]) -> None:
    link = ReplayLink(taped[0])
    env = gymnasium.make(ENV_ID, link=link, on_fault="raise")
    env.reset(seed=0)
    with pytest.raises(LinkLostError, match="episode ends here"):
        for _ in range(STEPS + 1):
            env.step(np.zeros(2, np.float32))
    env.reset()
    with pytest.raises(LinkLostError, match="all 2 episodes"):
        env.reset()
    env.close()


@pytest.mark.parametrize(
    "text",
    ["", "nonsense\n", "[1, 2]\n", '{"sent": "", "got": "", "t": 0}\n', '{"reset": 0}\n{"t": 1}\n'],
)
def test_files_that_are_no_recordings_say_so(tmp_path: Path, text: str) -> None:
    tape = tmp_path / "broken.jsonl"
    tape.write_text(text)
    with pytest.raises(ConfigError, match=r"recording|holds no episode"):
        ReplayLink(tape).open()


def test_a_missing_recording_says_so(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="there is no such file"):
        open_link(f"replay:{tmp_path / 'none.jsonl'}").open()


def test_a_recording_that_cannot_be_written_says_so(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="can't be written"):
        RecordingLink(open_link("planar"), tmp_path / "no" / "folder.jsonl").open()
