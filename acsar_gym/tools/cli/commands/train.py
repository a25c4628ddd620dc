"""The command `train`."""

from __future__ import annotations

import signal

from acsar_gym.tools.cli.commands import command
from acsar_gym.tools.training.options import TrainingOptions


@command("train", "policies")
def train_policy(training: TrainingOptions) -> int:
    """Train a policy on one of the environments and export it as one ONNX file.

    Ctrl-C and SIGTERM end it early, and save the model.

    Args:
        training: the training.
    """
    if training.warm_up:
        return warm_up(training)
    from acsar_gym.tools.training.run import train  # noqa: PLC0415
    from acsar_gym.tools.training.seeds import train_seeds  # noqa: PLC0415

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


def warm_up(options: TrainingOptions) -> int:
    """Compile the loops of an env, and generate its worlds."""
    from acsar_gym.tools.warm_up import warm_env  # noqa: PLC0415

    done = warm_env(options.env, options.robot)
    worlds = f", {done.worlds} worlds at hand" if done.worlds else ""
    print(f"{options.env}: {done.functions} functions compiled{worlds}, {done.seconds:.1f} s")
    return 0
