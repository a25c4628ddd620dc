"""Compile and generate ahead of time what the first use of an environment needs.

That is the compiled loops and the worlds of a batch, which are kept on disk.
"""

from __future__ import annotations

import contextlib
import logging
import threading
import time
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import gymnasium
import numpy as np
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn

from acsar_gym import jit as compiled
from acsar_gym.config import RobotConfig
from acsar_gym.envs import ids
from acsar_gym.registration import IDS, snake_case

ENV_NAMES = tuple(snake_case(name.partition("-")[0]) for name in IDS)
"""Names of the ids that are warmed up where none is given."""
BATCH_FUNCTIONS = 97
"""Functions that a first batch of PointGoal compiles (`make test-slow` counts them)."""
TYPING_SHARE = 0.85
"""Share of the time in which they are begun; then LLVM is at work on the largest."""
SHOW_PERIOD = 0.2
"""Time between two updates of the progress [s]."""


class WarmUp(NamedTuple):
    """Counts and duration of a warm-up of one id."""

    functions: int
    """How many functions were compiled."""
    worlds: int
    """How many worlds are kept on disk now."""
    seconds: float
    """How long it took [s]."""


def warm_env(
    name: str, robot: RobotConfig | str | Path | None = None, options: Mapping[str, Any] = {}
) -> WarmUp:
    """Reset and step an env and a batch of one id once.

    Args:
        name: such as "point_goal" or "mine.module:mine/Clearance-v0".
        robot: preset or config file.
        options: of the env, such as worlds.

    Raises:
        ConfigError: there is no such env.
    """
    before, begin = len(compiled.NEWLY_COMPILED), time.perf_counter()
    level = compiled.LOG.level
    compiled.LOG.setLevel(logging.ERROR)  # no warning that compiling takes a minute
    try:
        env_id = ids.find_id(name)
        one = gymnasium.make(env_id, link="planar", robot=robot, **options)
        one.reset(seed=0)
        one.step(np.zeros(2, np.float32))
        one.close()
        many = ids.make_vec(env_id, 2, robot=robot, **options)
        many.reset(seed=0)
        many.step(np.zeros((2, 2)))
        many.close()
    finally:
        compiled.LOG.setLevel(level)
    worlds = 0 if many.pool is None else len(many.pool)
    return WarmUp(len(compiled.NEWLY_COMPILED) - before, worlds, time.perf_counter() - begin)


@contextlib.contextmanager
def show_compilation(console: Console) -> Iterator[None]:
    """Show how far a first batch of PointGoal is compiled, and the time left, while the block runs.

    Args:
        console: to draw the bar on; nothing is drawn where all has been compiled before.
    """
    done, known, begin = threading.Event(), len(compiled.NEWLY_COMPILED), time.monotonic()

    def follow(bar: Progress) -> None:
        task, begun, reached = bar.add_task("", total=1.0, visible=False, left=""), 0, begin
        while not done.wait(SHOW_PERIOD):
            now, before = time.monotonic(), begun
            begun = min(len(compiled.NEWLY_COMPILED) - known, BATCH_FUNCTIONS)
            reached = now if begun > before else reached
            share = TYPING_SHARE * begun / BATCH_FUNCTIONS
            if share > 0.0:
                left = max(0.0, (reached - begin) / share - (now - begin))
                about = f"about {left:.0f} s left" if begun > 10 else ""
                ready = max(share, 1.0 - left / (left + now - begin))
                bar.update(task, completed=ready, left=about, visible=True)
        bar.update(task, completed=1.0, left="")

    text = TextColumn("compiling, once after each installation")
    with Progress(text, BarColumn(), TextColumn("{task.fields[left]}"), console=console) as bar:
        follower = threading.Thread(target=follow, args=(bar,), daemon=True)
        follower.start()
        try:
            yield
        finally:
            done.set()
            follower.join()
