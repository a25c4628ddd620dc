"""Ray clusters of several nodes on this machine."""

from __future__ import annotations

import contextlib
import os
import signal
from collections.abc import Iterator
from pathlib import Path
from typing import Any

TESTS = Path(__file__).parent


class Nodes:
    """A running cluster, whose nodes have one CPU each."""

    def __init__(self, count: int) -> None:
        from ray.cluster_utils import Cluster

        self._cluster: Any = Cluster(
            initialize_head=True, head_node_args={"num_cpus": 1, "include_dashboard": False}
        )
        self.workers = [self._cluster.add_node(num_cpus=1) for _ in range(count - 1)]
        self._cluster.wait_for_nodes()

    @property
    def address(self) -> str:
        """What `--address` takes."""
        address: str = self._cluster.address
        return address

    def kill(self, number: int) -> None:
        """SIGKILL a node that isn't the head, as when its power fails."""
        (raylet,) = self.workers[number].all_processes["raylet"]
        os.kill(raylet.process.pid, signal.SIGKILL)

    def end(self) -> None:
        """End all processes."""
        self._cluster.shutdown()


@contextlib.contextmanager
def nodes(count: int) -> Iterator[Nodes]:
    """Run a cluster inside the block. Its processes can import the tests' modules."""
    usual = {name: os.environ.get(name) for name in ("PYTHONPATH", "RAY_USAGE_STATS_ENABLED")}
    os.environ.update(
        PYTHONPATH=os.pathsep.join([str(TESTS), str(TESTS.parent)]), RAY_USAGE_STATS_ENABLED="0"
    )
    running = Nodes(count)
    try:
        yield running
    finally:
        running.end()
        for name, value in usual.items():
            os.environ.pop(name) if value is None else os.environ.update({name: value})
