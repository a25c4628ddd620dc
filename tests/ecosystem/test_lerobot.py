"""LeRobot reads the data sets that `acsar-gym record export --to lerobot` writes."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from recording_tools import record_drive

from acsar_gym.tools.datasets import read_demonstrations

READ = """
import json
import torch

if torch.version.cuda is None:  # PyPI's torchvision is built for CUDA, and lacks its operators then
    operators = torch.library.Library("torchvision", "DEF")
    for name in ("nms", "qnms"):
        operators.define(f"{name}(Tensor dets, Tensor scores, float iou_threshold) -> Tensor")

from lerobot.datasets.lerobot_dataset import LeRobotDataset

ahead = {"action": [0.0, 0.1]}
data = LeRobotDataset("acsar/drive", root="data", delta_timestamps=ahead)
frames = [data[number] for number in range(len(data))]
keys = ("observation.state", "action", "next.done", "timestamp", "episode_index")
dataset = {key: [frame[key].tolist() for frame in frames] for key in keys}
dataset |= {"fps": data.fps, "task": frames[0]["task"], "episodes": data.num_episodes}
dataset["mean"] = data.meta.stats["action"]["mean"].tolist()
print(json.dumps(dataset))
"""


def test_lerobot_reads_the_drives_back(tmp_path: Path) -> None:
    first = record_drive(tmp_path / "1.mcap", [(0.4, 0.2, 200), (0.3, -0.5, 133)])
    second = record_drive(tmp_path / "2.mcap", [(0.2, 0.0, 411)])
    export = [sys.executable, "-m", "acsar_gym", "record", "export", str(first), str(second)]
    subprocess.run(
        [*export, "--to", "lerobot", "--out", "data"], cwd=tmp_path, check=True, timeout=600
    )
    done = subprocess.run(
        [sys.executable, "-c", READ],
        cwd=tmp_path,
        env=os.environ | {"HF_HUB_OFFLINE": "1", "HF_HOME": str(tmp_path / "hub")},
        capture_output=True,
        text=True,
        check=False,
        timeout=600,
    )
    assert done.returncode == 0, done.stderr[-3000:]

    dataset = json.loads(done.stdout.splitlines()[-1])
    episodes = read_demonstrations([first, second]).episodes
    assert (dataset["fps"], dataset["episodes"], dataset["task"]) == (
        10,
        2,
        "acsar_gym/PointGoal-v0",
    )
    observations = np.concatenate([episode.observations[:-1] for episode in episodes])
    np.testing.assert_array_equal(np.array(dataset["observation.state"], np.float32), observations)
    actions = np.concatenate([episode.actions for episode in episodes])
    pairs = np.array(
        dataset["action"], np.float32
    )  # (frames, 2, 2): of this step and the next step
    np.testing.assert_array_equal(pairs[:, 0], actions)
    ends = np.array(dataset["next.done"])
    np.testing.assert_array_equal(pairs[:-1, 1][~ends[:-1]], actions[1:][~ends[:-1]])
    assert ends.sum() == 2
    np.testing.assert_allclose(dataset["mean"], actions.mean(axis=0), atol=1e-6)
