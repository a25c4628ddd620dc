"""Jobs that tell what they cost."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any


@dataclass(frozen=True)
class Cost:
    """What a job took."""

    units: int
    """Episodes, or env steps of a training."""
    cpu: float
    """CPU time of the process [s]; doesn't grow with what else the machine does."""
    wall: float
    """[s]"""


def measured(work: Callable[[Any], int], job: Any) -> Cost:
    """Run a job; `work` returns its units."""
    begin, cpu = time.perf_counter(), time.process_time()
    units = work(job)
    return Cost(units, time.process_time() - cpu, time.perf_counter() - begin)


def evaluate(shard: Any) -> Cost:
    """Run the episodes of a shard."""
    from acsar_gym.tools.evaluation import shards

    return measured(lambda job: len(shards.run_shard(job)), shard)


def train(options: Any) -> Cost:
    """Train with options whose folder is a temporary one."""
    from dataclasses import replace

    from acsar_gym.tools.training import run

    def trained(options: Any) -> int:
        with tempfile.TemporaryDirectory() as folder:
            run.train(replace(options, out=Path(folder)))
        steps: int = options.steps
        return steps

    return measured(trained, options)
