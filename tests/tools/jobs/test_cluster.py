"""Addresses of Ray clusters; tests/scale has the clusters."""

from __future__ import annotations

import socket
import sys

import pytest
from job_tools import threads

from acsar_gym.errors import ClusterError, MissingExtraError
from acsar_gym.tools.jobs import cluster, completed

pytestmark = pytest.mark.xdist_group(__name__)


@pytest.fixture(autouse=True)
def _impatient(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cluster, "CLUSTER_TIMEOUT", 0.1)
    monkeypatch.delenv("RAY_ADDRESS", raising=False)


@pytest.mark.parametrize("kind", ["", "ray://"])
def test_an_address_that_doesnt_answer_is_one_error(
    kind: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Nothing listens there, or a program that isn't Ray."""
    with socket.create_server(("127.0.0.1", 0)) as server:
        host = f"127.0.0.1:{server.getsockname()[1]}"
        with pytest.raises(ClusterError, match=f"--address '{kind}{host}': doesn't answer"):
            list(completed(threads, [""], address=f"{kind}{host}"))
    with pytest.raises(ClusterError, match="doesn't answer: start a cluster"):
        list(completed(threads, [""], address=f"{kind}{host}"))
    monkeypatch.setenv("RAY_ADDRESS", f"{kind}{host}")
    with pytest.raises(ClusterError, match="--address 'auto': doesn't answer"):
        list(completed(threads, [""], address="auto"))


def test_without_ray_the_error_names_the_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "ray", None)
    with pytest.raises(MissingExtraError, match=r"pip install 'acsar_gym\[scale\]'"):
        list(completed(threads, [""], address="auto"))
