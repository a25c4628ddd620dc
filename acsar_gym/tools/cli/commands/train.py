"""The command `train`."""

from __future__ import annotations

import sys

from acsar_gym.tools.cli.commands import command


@command("train", "policies")
def train_policy() -> int:
    """Train a policy and export it, with options of its own."""
    from acsar_gym.tools.training.seeds import main  # noqa: PLC0415

    return main(sys.argv[2:])
