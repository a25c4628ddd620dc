"""docs/your-own-*.md: their code, as a user would save it, in all modes."""

from __future__ import annotations

import importlib
import os
import pty
import re
import sys
import threading
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import gymnasium
import numpy as np
import pytest

from acsar_gym import RobotConfig, open_link
from acsar_gym.errors import LinkError
from acsar_gym.sensors import SensorInput
from acsar_gym.worlds import registry

DOCS = Path(__file__).resolve().parents[2] / "docs"
PAGES = {name: DOCS / f"your-own-{name}.md" for name in ("task", "sensor", "robot", "world")}
TASK = "mine.clearance:mine/Clearance-v0"
FENCE = {"min_x": -0.6, "max_x": 4.0, "min_y": -3.0, "max_y": 3.0}
ROBOT: dict[str, Any] = {
    "geofence": FENCE,
    "linear_limits": {"max_acceleration": 1.5, "max_jerk": 30.0},
    "angular_limits": {"max_acceleration": 6.0},
}
STEPS = 300


@pytest.fixture(scope="module")
def mine(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """A user's package with the files of the pages."""
    folder = tmp_path_factory.mktemp("users")
    package = folder / "mine"
    package.mkdir()
    (package / "__init__.py").touch()
    text = "".join(page.read_text(encoding="utf-8") for page in PAGES.values())
    for name, code in re.findall(r"^```python\n# mine/(\w+\.py)\n(.*?)^```", text, re.M | re.S):
        (package / name).write_text(code, encoding="utf-8")
    sys.path.insert(0, str(folder))
    importlib.invalidate_caches()

    yield package

    sys.path.remove(str(folder))
    for task in ("Clearance", "Park", "Feeling"):
        gymnasium.registry.pop(f"mine/{task}-v0", None)
    registry.REGISTERED.pop("corridors", None)
    for name in [name for name in sys.modules if name.split(".")[0] == "mine"]:
        del sys.modules[name]


def test_own_task_is_equal_in_a_batch_and_in_single_envs(mine: Path) -> None:
    """Limits and a geofence included, through the ends of episodes."""
    importlib.import_module("mine.clearance")
    options: dict[str, Any] = {"robot": ROBOT, "worlds": "clutter:8"}
    robots = 16
    batch: Any = gymnasium.make_vec(
        TASK, robots, vectorization_mode="vector_entry_point", autoreset_mode="NextStep", **options
    )
    singles = [gymnasium.make(TASK, link="planar", **options) for _ in range(4)]
    observations, _ = batch.reset(seed=7)
    for robot, env in enumerate(singles):
        np.testing.assert_allclose(env.reset(seed=7 + robot)[0], observations[robot], atol=1e-6)

    # Forwards in arcs, with sudden changes.
    rng = np.random.default_rng(5)
    pushes = rng.uniform([-0.3, -1.0], [1.0, 1.0], (STEPS // 4, robots, 2)).astype(np.float32)
    over = [False] * len(singles)
    held = 0
    ends = 0
    for action in np.repeat(pushes, 4, axis=0):
        observations, rewards, terminated, truncated, info = batch.step(action)
        held += int((info["sent_reason"] == 2.0).any())
        for robot, env in enumerate(singles):
            single: Any = env.reset() if over[robot] else env.step(action[robot])
            reward, *ended = [0.0, False, False] if over[robot] else single[1:4]
            np.testing.assert_allclose(single[0], observations[robot], atol=1e-6)
            assert rewards[robot] == pytest.approx(reward, abs=1e-6)
            assert ended == [terminated[robot], truncated[robot]]
            over[robot] = any(ended)
            ends += any(ended)
    assert held > 0  # the fence was met
    assert ends > 0
    for env in (*singles, batch):
        env.close()


def test_own_sensor_reads_its_device_on_hardware(mine: Path) -> None:
    """Its link knows no truth. The newest whole line counts, and silence is a fault."""
    finder = importlib.import_module("mine.finder")
    rays = importlib.import_module("mine.rays")
    link = SimpleNamespace(truth=None)
    config = RobotConfig()
    sensor = finder.three_rays(link, config)
    assert type(finder.three_rays(open_link("planar", config), config)) is rays.ThreeRays
    board, device = pty.openpty()
    sensor.device = os.ttyname(device)
    talking = threading.Timer(0.1, os.write, (board, b"9 9\n1.5 0.3 6.0\n"))
    talking.start()

    def read(now: float) -> Any:
        nothing = np.full((1, 3), np.nan)
        clock = np.array([now])
        robots = SensorInput(nothing, nothing, nothing, now=clock, scenes=[], rngs=[], memory=0)
        out = np.zeros((1, 3))
        sensor.read(robots, out)
        return out[0]

    sensor.reset(None)
    sensor.poll(None, 1.0)
    np.testing.assert_allclose(read(1.0), [0.5, 0.1, 1.0])
    os.write(board, b"3.0 0.6 0.6\n0.")
    while sensor.fresh != 1.2:  # until the terminal has passed on the line
        sensor.poll(None, 1.2)
    np.testing.assert_allclose(read(1.2), [1.0, 0.2, 0.2])
    with pytest.raises(LinkError, match="silent"):
        read(1.9)
    sensor.close()
    os.close(board)
    os.close(device)
