"""Compare agents over scenes, seeds and conditions, and write the table."""

from acsar_gym.tools.benchmark.scenes import SCENES, Scenes, SceneSet

__all__ = ["SCENES", "SceneSet", "Scenes"]
