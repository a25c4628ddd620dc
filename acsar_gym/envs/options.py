"""The options that all environments have, beside those of their task."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from typing import Any, Self

from acsar_gym.errors import ConfigError, RenderError, shown
from acsar_gym.tasks.options import listed, with_defaults

RENDER_MODES = ("human", "rgb_array")


@dataclass(frozen=True, kw_only=True)
class EnvOptions:
    """The options of a single environment.

    The manual of `acsar_gym/PointGoal-v0` describes them.
    """

    worlds: Any = None
    difficulty: Any = None
    lidar: Any = None
    sensors: Sequence[Any] = ()
    policy_rate: float = 10.0
    render_mode: str | None = None
    view: str = "top"
    faults: Any = None
    randomization: Any = None
    on_fault: str = "truncate"

    def __post_init__(self) -> None:
        listed("sensors", self.sensors)
        if self.render_mode not in (None, *RENDER_MODES):
            raise ConfigError(
                f"render_mode = {shown(self.render_mode)}: must be None, human or rgb_array"
            )
        if not isinstance(self.view, str) or self.view not in ("top", "camera"):
            raise ConfigError(f"view = {shown(self.view)}: must be top or camera")
        if not isinstance(self.on_fault, str) or self.on_fault not in ("raise", "truncate"):
            raise ConfigError(f"on_fault = {shown(self.on_fault)}: must be raise or truncate")

    @classmethod
    def names(cls) -> tuple[str, ...]:
        """Names of all options."""
        return tuple(field.name for field in fields(cls))

    @classmethod
    def split(cls, given: Mapping[str, Any]) -> tuple[Self, dict[str, Any]]:
        """Separate the options of the env from those of the task.

        Args:
            given: all options, by name; "defaults" has those that `acsar_gym.register` was given
                and only one mode knows.

        Returns:
            The env's options, and the others.

        Raises:
            ConfigError: for values that are unknown.
        """
        own = cls.names()
        asked = with_defaults(given, own)
        rest = {name: value for name, value in asked.items() if name not in own}
        return cls(**{name: value for name, value in asked.items() if name in own}), rest

    def check_view(self, link: Any) -> None:
        """Raise RenderError for view="camera" where the link has no camera."""
        if self.view == "camera" and isinstance(link, str) and link != "bullet":
            raise RenderError(f"link {link!r} has no camera; view='camera' needs link='bullet'")
