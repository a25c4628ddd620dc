"""Ray clusters of several nodes on this machine."""

from __future__ import annotations

import contextlib
import os
import signal
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

TESTS = Path(__file__).parent


class Nodes:
    """A running cluster, whose nodes have one CPU each."""

    def __init__(self, count: int) -> None:
        from ray.cluster_utils import Cluster

        self.cluster: Any = Cluster(
            initialize_head=True, head_node_args={"num_cpus": 1, "include_dashboard": False}
        )
        self.workers = [self.cluster.add_node(num_cpus=1) for _ in range(count - 1)]
        self.cluster.wait_for_nodes()
        self.address: str = self.cluster.address

    def kill(self, number: int) -> None:
        """SIGKILL a node that isn't the head, as when its power fails."""
        (raylet,) = self.workers[number].all_processes["raylet"]
        os.kill(raylet.process.pid, signal.SIGKILL)


@contextlib.contextmanager
def nodes(count: int) -> Iterator[Nodes]:
    """Run a cluster inside the block. Its processes can import the tests' modules."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("PYTHONPATH", os.pathsep.join([str(TESTS), str(TESTS.parent)]))
        patch.setenv("RAY_USAGE_STATS_ENABLED", "0")
        running = Nodes(count)
        try:
            yield running
        finally:
            running.cluster.shutdown()
