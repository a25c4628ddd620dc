"""The command `train`."""

from __future__ import annotations

import signal

from acsar_gym.tools.cli.commands import command
from acsar_gym.tools.training.options import TrainingOptions


@command("train")
def train_policy(training: TrainingOptions) -> int:
    """Train a policy on one of the environments and export it as one ONNX file.

    Ctrl-C and SIGTERM end it early, and save the model.

    Args:
        training: The training.
    """
    if training.warm_up:
        from acsar_gym.tools.warm_up import warm_env

        warmed = warm_env(training.env, training.robot)
        worlds = f", {warmed.worlds} worlds at hand" if warmed.worlds else ""
        functions = f"{warmed.functions} functions compiled"
        print(f"{training.env}: {functions}{worlds}, {warmed.seconds:.1f} s")
        return 0
    from acsar_gym.tools.training.run import train
    from acsar_gym.tools.training.seeds import train_seeds

    try:
        if training.seeds is None:
            train(training)
        else:
            train_seeds(training)
    except KeyboardInterrupt as end:
        if end.args == (signal.SIGTERM.name,):
            return 128 + signal.SIGTERM
        raise
    return 0
