"""Train a policy on thousands of planar robots and export it as one ONNX file.

    acsar-gym train --env obstacle_goal --out runs/obstacle_goal
    acsar-gym train --env mine.module:mine/Clearance-v0 --steps 2000000 --algo sac
    acsar-gym train --env obstacle_goal --seeds 0-4 --workers 2

The hyperparameters are in agents/recipes/, in RL Zoo's format. Into the folder go:

| file | for |
|---|---|
| policy.onnx | to drive with |
| model.zip | to train on: --resume model.zip --trust begins a new training with it |
| checkpoints/ | to go on after a kill: --resume FOLDER --trust, with the same learning curve |
| config.yml | hyperparameters, versions, git revision, command line; also a --conf-file |
| learning_curve.csv, .png | success, return and collisions of the held-out episodes |
| tensorboard/ | these, and the algorithm's own figures |

Ctrl-C and SIGTERM end it early, and save the model. The success rate on held-out robots, in worlds
that aren't trained in, is logged as eval/success_rate; with --worlds FILE or FOLDER there are no
other worlds, so it is measured in the same ones, with other seeds.
"""

from __future__ import annotations

from collections.abc import Sequence

import tyro

from acsar_gym.training import seeds
from acsar_gym.training.options import Options
from acsar_gym.training.run import train


def main(arguments: Sequence[str]) -> int:
    """Train with the options of a command line; returns the exit code."""
    options = tyro.cli(Options, prog="acsar-gym train", args=list(arguments))
    return train(options) if options.seeds is None else seeds.train(options)
