"""The options that all environments have, beside those of their task."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from acsar_gym.errors import ConfigError, RenderError, shown
from acsar_gym.lidars.factory import factories
from acsar_gym.sensors import LIDAR, Factory, Sensor
from acsar_gym.tasks import Task
from acsar_gym.tasks.made import named
from acsar_gym.tasks.options import Options

RENDER_MODES = ("human", "rgb_array")


@dataclass(frozen=True, kw_only=True)
class EnvOptions(Options):
    """The options of a single environment.

    The manual of `acsar_gym/PointGoal-v0` describes them.
    """

    lidar: Any = None
    view: str = "top"
    on_fault: str = "truncate"
    record: Any = None

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.render_mode not in (None, *RENDER_MODES):
            raise ConfigError(
                f"render_mode = {shown(self.render_mode)}: must be None, human or rgb_array"
            )
        if not isinstance(self.view, str) or self.view not in ("top", "camera"):
            raise ConfigError(f"view = {shown(self.view)}: must be top or camera")
        if not isinstance(self.on_fault, str) or self.on_fault not in ("raise", "truncate"):
            raise ConfigError(f"on_fault = {shown(self.on_fault)}: must be raise or truncate")

    def factories(self, task: Task) -> list[Sensor | Factory]:
        """Return the factories of a task's sensors and these.

        Args:
            task: of the env.

        Raises:
            ConfigError: there is a `lidar` for a task that uses none, or an unknown sensor.
        """
        names = (*task.sensors, *self.sensors)
        if self.lidar is not None and LIDAR not in names:
            raise ConfigError(f"lidar = {shown(self.lidar)}: {named(task)} uses none")
        return factories(names, self.lidar)

    def check_view(self, link: Any) -> None:
        """Raise RenderError for view="camera" where the link has no camera."""
        if self.view == "camera" and isinstance(link, str) and link != "bullet":
            raise RenderError(f"link {link!r} has no camera; view='camera' needs link='bullet'")
