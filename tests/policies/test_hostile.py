"""Policy files as an attacker would make them: one line each, before they cost anything."""

from __future__ import annotations

import os
import resource
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from onnx_tools import ENV_ID, GOOD, HOSTILE, Maker, bundle_of, relabelled

from acsar_gym.errors import ConfigError, PolicyError
from acsar_gym.tools.evaluation import runs
from acsar_gym.tools.policies import OnnxPolicy, trial
from acsar_gym.tools.policies.limits import plain
from acsar_gym.tools.policies.onnx import MAX_POLICY_BYTES, inspect_network
from acsar_gym.tools.policies.protobuf import Message, ProtobufError


def refused(path: Path) -> str:
    """The one line with which a policy file is refused."""
    with pytest.raises(PolicyError) as raised:
        runs.make_env(runs.load_policy(str(path), trust=False), "planar", None, {})
    said = str(raised.value)
    assert said.startswith(str(path))
    assert "\n" not in said
    assert len(said) < 400
    return said


@pytest.mark.parametrize("make", HOSTILE, ids=lambda make: make.__name__)
def test_a_hostile_file_is_one_line(
    make: Callable[[], bytes], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("weights.bin").write_bytes(bytes(56))  # what external data would be taken from
    path = tmp_path / "policy.onnx"
    path.write_bytes(make())
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    largest = resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss  # of other tests' children
    assert HOSTILE[make] in refused(path)
    grown = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before
    assert grown < 300_000  # kB
    assert resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss <= max(
        largest,
        before + 100_000,
        1_500_000,  # a child begins with the size of its parent
    )


@pytest.mark.parametrize("domain", ["ai.onnx.ml", "pkg.onnxscript.torch_lib"])
def test_only_the_operations_that_are_used_count(domain: str, tmp_path: Path) -> None:
    """Other tools list packages that no node needs."""
    unused, used, path = Maker(), Maker(), tmp_path / "policy.onnx"
    for make, of in ((unused, ""), (used, domain)):
        make.domains.append((domain, 1))
        make.dense(make.add("Tanh", "observation", domain=of), 7)
    path.write_bytes(unused.bytes())
    assert OnnxPolicy(path)(np.zeros(7, np.float32)).tolist() == [0.0, 0.0]
    path.write_bytes(used.bytes())
    assert f"an operation of {domain!r}" in refused(path)


def test_devices_pipes_and_large_files_are_not_read(tmp_path: Path) -> None:
    pipe, large = tmp_path / "pipe.onnx", tmp_path / "large.onnx"
    os.mkfifo(pipe)
    with large.open("wb") as file:
        file.truncate(MAX_POLICY_BYTES + 1)
    assert "regular file" in refused(pipe)
    assert "larger than 32 MB" in refused(large)
    assert "regular file" in refused(Path("/dev/zero"))


@pytest.mark.parametrize("cut", range(0, 400, 7))
def test_no_cut_or_changed_file_gets_past_as_anything_but_a_policy(cut: int) -> None:
    data = GOOD.read_bytes()
    rng = np.random.default_rng(cut)
    changed = bytearray(data)
    for place in rng.integers(0, 600, 5):
        changed[place] = rng.integers(256)
    for content in (data[:cut], data[:-cut] if cut else b"", bytes(changed)):
        try:
            inspect_network(content)
        except PolicyError as error:
            assert "\n" not in str(error)  # noqa: PT017 - most are refused, some are harmless


def test_repeated_parts_are_merged_as_protobuf_does() -> None:
    """A second graph in the file adds its nodes: none is hidden behind the last one."""
    make = Maker()
    make.dense("observation", 7)
    loop = Maker()
    loop.add("Loop", "observation")
    hidden = loop.model()
    for part in ("input", "output"):
        hidden.graph.ClearField(part)
    with pytest.raises(PolicyError, match="Loop"):
        inspect_network(hidden.SerializeToString() + make.bytes())


@pytest.mark.parametrize(
    "data", [b"\x0a", b"\x0a\x05x", b"\x0b\x0c", b"\x00\x01", b"\xff" * 11, b"\x08" + b"\xff" * 9]
)
def test_broken_messages_are_said_so(data: bytes) -> None:
    with pytest.raises(ProtobufError):
        Message(data)


def test_negative_packed_and_single_numbers_are_read() -> None:
    message = Message(b"\x08\x05\x0a\x02\x07\x08\x08" + b"\xff" * 9 + b"\x01")
    assert message.integers(1) == [5, 7, 8, -1]
    assert message.integer(1) == -1
    assert (message.integer(2), message.text(2)) == (0, "")


def test_plain_networks_need_no_trial(monkeypatch: pytest.MonkeyPatch) -> None:
    """Loading one costs a few ms, on a robot's onboard computer, too."""

    def tried(*_: object) -> str:
        raise AssertionError

    monkeypatch.setattr(trial, "find_refusal", tried)
    for path in GOOD.parent.glob("*.onnx"):
        OnnxPolicy(path)


def sliced(make: Maker, first: int, last: int) -> str:
    """Some numbers of the observation."""
    ends = [make.weight([number], np.int64) for number in (first, last, 1, 1)]
    return make.add("Slice", "observation", *ends)


def test_networks_that_change_a_part_of_the_observation_need_no_trial() -> None:
    """As those do that take logarithms of a LiDAR's ranges."""
    make = Maker()
    rays = make.add("Sub", sliced(make, 3, 7), make.weight([0.1, 0.2, 0.3, 0.4]))
    logs = make.add("Log", make.add("Add", rays, make.weight(0.5)))
    parts = make.add("Concat", sliced(make, 0, 3), logs, axis=1)
    make.add("Tanh", make.dense(parts, 7, out="d"), out="action")
    assert plain(inspect_network(make.bytes())[0])


@pytest.mark.parametrize("axis", [0, 2])
def test_rows_below_each_other_are_tried(axis: int) -> None:
    """Their product could be anything."""
    make = Maker()
    make.dense(make.add("Concat", "observation", "observation", axis=axis), 7)
    assert not plain(inspect_network(make.bytes())[0])


def test_weights_of_several_rows_are_tried() -> None:
    for op in ("Add", "Mul"):
        make = Maker()
        square = make.add(op, "observation", make.weight(np.zeros((500, 7))))
        make.dense(make.add("ReduceMax", square, make.weight([0], np.int64), keepdims=1), 7)
        assert not plain(inspect_network(make.bytes())[0])
        column = Maker()
        column.dense(column.add(op, column.weight(np.zeros((500, 1))), "observation"), 7)
        assert not plain(inspect_network(column.bytes())[0])


def test_other_networks_are_tried_once(tmp_path: Path) -> None:
    make = Maker()
    lanes = make.add("Unsqueeze", "observation", make.weight([1], np.int64))
    filtered = make.add("Conv", lanes, make.weight(np.full((4, 1, 3), 0.1)))
    make.dense(make.add("Flatten", filtered), 20)
    data = make.bytes()
    assert not plain(inspect_network(data)[0])
    path = tmp_path / "convolution.onnx"
    path.write_bytes(data)
    assert OnnxPolicy(path)(np.ones(7, np.float32)).tolist() == pytest.approx([0.06, 0.06])


@pytest.mark.parametrize("env_id", ["GymV21Environment-v0", "phys2d/CartPole-v1", "CartPole-v1"])
def test_a_file_chooses_among_the_environments_of_this_package_alone(
    env_id: str, tmp_path: Path
) -> None:
    path = relabelled(tmp_path / "other.onnx", env__id=env_id)
    assert "which isn't acsar_gym's: if you trust that package, name it with --env" in refused(path)
    policy = runs.load_policy(str(path), trust=False, env=ENV_ID)
    runs.make_env(policy, "planar", None, {}).close()
    with pytest.raises(ConfigError, match="no_such_module"):
        runs.load_policy(str(path), trust=False, env="no_such_module:x-v0")


def test_what_a_file_says_cannot_steer_a_terminal(tmp_path: Path) -> None:
    names = [f"\x1b]0;{name}\x07" for name in bundle_of().observation.names]
    for values in ({"env__id": "\x1b[2Jx"}, {"observation__names": names}):
        path = relabelled(tmp_path / "escape.onnx", **values)
        assert "\x1b" not in refused(path)


def looked_up(axes: list[int], keepdims: int = 0) -> bytes:
    """A network that looks two numbers up in a table, and keeps the least along these axes."""
    make = Maker()
    cells = make.add("Cast", sliced(make, 0, 2), to=7)  # int64
    found = make.add("Gather", make.weight(np.ones((4, 2))), cells, axis=0)
    least = make.weight(axes, np.int64)
    made = make.add("ReduceMin", found, least, keepdims=keepdims) if axes else found
    make.add("Tanh", made, out="action")
    return make.bytes()


def test_the_least_numbers_of_a_table_need_no_trial() -> None:
    """As those of the arcs do, which look up how far a robot can drive along them."""
    assert plain(inspect_network(looked_up([1]))[0])


@pytest.mark.parametrize(("axes", "keepdims"), [([], 0), ([0], 0), ([0], 1), ([1], 1), ([0, 1], 0)])
def test_what_is_looked_up_is_tried_where_more_than_a_row_may_go_on(
    axes: list[int], keepdims: int
) -> None:
    """Each further table would multiply it: a file of 7 kB could fill the memory."""
    assert not plain(inspect_network(looked_up(axes, keepdims))[0])
