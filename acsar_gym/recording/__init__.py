"""Recordings of a robot's drives: MCAP files that ROS 2 and its tools read, and this package."""

from acsar_gym.recording.reader import read
from acsar_gym.recording.recorder import Recorder
from acsar_gym.recording.types import Episode, Recording, WireLog

__all__ = ["Episode", "Recorder", "Recording", "WireLog", "read"]
