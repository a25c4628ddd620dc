"""Compile the shared kernels once: `make test` runs this before pytest's workers start.

Workers that start together would each compile the same kernels.
"""

from __future__ import annotations

from acsar_gym.tools import warm_up

WORLDS = {
    "barn": "barn:1",
    "obstacle_goal": "open:2",
    "crowd": "crowd:2",
    "dyna_barn": "dynabarn:2",
    "path_follow": "smooth_path:2",
}
"""Worlds of ids that have any, as few as possible."""


def warm(name: str) -> warm_up.WarmUp:
    """Compile what an env and a batch of one id need."""
    options = {"worlds": WORLDS[name]} if name in WORLDS else {}
    return warm_up.warm_env(name, options=options)


if __name__ == "__main__":
    for env_name in warm_up.ENV_NAMES:
        warm(env_name)
