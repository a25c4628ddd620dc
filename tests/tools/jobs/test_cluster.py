"""Addresses of Ray clusters; tests/scale has the clusters."""

from __future__ import annotations

import socket
import sys

import pytest
from job_tools import threads

from acsar_gym.errors import ClusterError, ConfigError, MissingExtraError
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


@pytest.mark.parametrize("address", ["", "host:", ":6379", "host:port", "ray://host"])
def test_an_address_without_host_or_port_is_refused(address: str) -> None:
    with pytest.raises(ConfigError, match=r"must be local, auto, host:port or ray://host:port"):
        list(completed(threads, [""], address=address))


def test_without_ray_the_error_names_the_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "ray", None)
    with pytest.raises(MissingExtraError, match=r"pip install 'acsar_gym\[scale\]'"):
        list(completed(threads, [""], address="auto"))
