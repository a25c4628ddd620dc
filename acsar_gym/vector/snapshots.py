"""The whole state of a batch as arrays, to go on with it in another process."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from numpy.typing import NDArray

from acsar_gym.errors import ConfigError
from acsar_gym.vector.env import RobotVectorEnv


def taken(env: RobotVectorEnv) -> dict[str, NDArray[Any]] | None:
    """Copy all arrays of a batch, those of its generators included.

    Args:
        env: a batch that has been reset, with autoreset in the same step.

    Returns:
        Arrays by name; None where the batch has tasks or sensors written in Python, whose state
        isn't known.
    """
    arrays = env.batch.changing()
    return None if arrays is None else {name: array.copy() for name, array in arrays.items()}


def restore(env: RobotVectorEnv, arrays: Mapping[str, NDArray[Any]]) -> None:
    """Bring a batch to where another one was; it needn't be reset then.

    Args:
        env: a batch of the same task, robot, worlds and options.
        arrays: what `taken` has returned.

    Raises:
        ConfigError: they are of another batch.
    """
    own = env.batch.changing() or {}
    wanted, given = (
        {name: (array.shape, array.dtype) for name, array in each.items()} for each in (own, arrays)
    )
    if wanted != given:
        other = sorted(n for n in wanted | given if wanted.get(n) != given.get(n))
        raise ConfigError(f"the state of another batch: other {', '.join(other[:3])}")
    for name, array in own.items():
        array[...] = arrays[name]
    env.go_on()
