"""Planners from the literature, which a learned policy should beat.

`acsar-gym evaluate --policy dwa --env obstacle_goal`. docs/baselines.md describes each.
"""

from __future__ import annotations

import importlib
from pathlib import Path

from acsar_gym.errors import PolicyError
from acsar_gym.resources import AGENTS
from acsar_gym.tools.baselines.base import BaselinePolicy

__all__ = [
    "AMONG_MOVERS",
    "BASELINES",
    "PRIVILEGED_BASELINES",
    "BaselinePolicy",
    "is_baseline",
    "load_baseline",
]
BASELINES = {
    "turn_drive": "laws:TurnDrive",
    "pure_pursuit": "laws:PurePursuit",
    "navfn": "navfn:Navfn",
    "dwa": "dwa:Dwa",
    "dwa_movers": "dwa:DwaMovers",
    "orca": "orca:Orca",
    "orca_true": "orca:OrcaTrue",
}
"""What `--policy` calls each, and its module in this package and class."""
PRIVILEGED_BASELINES = ("orca_true",)
"""Those that know what only a simulator does."""
AMONG_MOVERS = ("dwa_movers", "orca")
"""Those that are made for worlds with movers, and decide by their tracks."""


def is_baseline(policy: str) -> bool:
    """Whether a policy argument names a baseline. Files and packaged policies come first."""
    packaged = AGENTS / "policies" / f"{policy}.onnx"
    return policy in BASELINES and not Path(policy).exists() and not packaged.exists()


def load_baseline(name: str, env_id: str) -> BaselinePolicy:
    """Make a baseline.

    Args:
        name: One of `BASELINES`.
        env_id: Id of the env that it will drive.

    Raises:
        PolicyError: no env is named.
    """
    if not env_id:
        raise PolicyError(
            f"{name}: a baseline, which can drive more than one environment: name it, as in "
            f"--policy {name} --env obstacle_goal"
        )
    module, _, kind = BASELINES[name].partition(":")
    policy: BaselinePolicy = getattr(importlib.import_module(f"{__name__}.{module}"), kind)(env_id)
    return policy
