"""Fixtures of everything that talks to a serial device: the emulator in another process."""

from __future__ import annotations

import contextlib
import ctypes
import gc
import os
import signal
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

import pytest
import yaml
from hypothesis import settings

# torch's threads spin while they wait for each other: beside other programs that takes minutes.
os.environ.setdefault("OMP_NUM_THREADS", "1")
# MuJoCo chooses how to draw when it is first imported, and tests import it.
with contextlib.suppress(OSError):
    ctypes.CDLL("libEGL.so.1")
    os.environ.setdefault("MUJOCO_GL", "egl")
# --import-mode=importlib leaves them out.
sys.path.insert(0, str(Path(__file__).parent / "measure"))
sys.path.insert(0, str(Path(__file__).parent))

from serial_tools import Emulated, RobotFile, StartEmulator, start

from acsar_gym import RobotConfig
from acsar_gym.guard.estop import release_process

if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:  # as under nohup: tests of Ctrl-C need it
    signal.signal(signal.SIGINT, signal.default_int_handler)

for name in ("COLUMNS", "LINES"):  # readline, which pytest loads, sets them: tables would be narrow
    os.environ.pop(name, None)
    os.unsetenv(name)

# Examples aren't timed: the first one may compile. Where CI is set, they are the same every time.
settings.register_profile("ours", max_examples=30, deadline=None, derandomize="CI" in os.environ)
settings.register_profile("thorough", settings.get_profile("ours"), max_examples=400)
settings.load_profile("ours")

IN_REAL_TIME = {"deadline", "shared_emulator", "start_emulator"}
"""A test that asks for one of these talks to other processes, and mostly waits for them."""


def pytest_addoption(parser: pytest.Parser) -> None:
    """`--board COMMAND`: tests of a board use this program instead of `acsar-gym emulate`."""
    parser.addoption("--board", help="program with the output, log and signals of the emulator")


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Tests of one file that run in real time go to one worker, which starts its boards once.

    Such groups start first. Files that import torch have groups by their own mark.
    """
    for item in items:
        grouped = item.get_closest_marker("xdist_group") is not None
        if not grouped and IN_REAL_TIME & set(getattr(item, "fixturenames", ())):
            item.add_marker(pytest.mark.xdist_group(item.path.stem))


@pytest.fixture(scope="module", autouse=True)
def _frozen() -> None:
    """What is there when a module begins stays: collecting garbage in a test then takes 1 ms.

    Garbage is collected before: else a robot in a cycle would listen for stops as long as pytest.
    """
    gc.collect()
    gc.freeze()


@pytest.fixture(scope="module", autouse=True)
def _own_stops() -> Iterator[None]:
    """Emergency stops of a module reach no other robots of this computer, nor theirs these."""
    with pytest.MonkeyPatch.context() as patch, tempfile.TemporaryDirectory() as folder:
        patch.setenv("ACSAR_GYM_RUNTIME_DIR", folder)
        yield


@pytest.fixture(scope="session", autouse=True)
def _kept_worlds(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """Generated worlds are kept for this run of the tests, and not among the user's own."""
    base = tmp_path_factory.getbasetemp()
    with pytest.MonkeyPatch.context() as patch:
        run = base.parent if "PYTEST_XDIST_WORKER" in os.environ else base
        patch.setenv("ACSAR_GYM_CACHE", str(run / "cache"))
        yield


HANGS = 180.0
"""A test that takes longer hangs [s]. Programs that it starts may compile for a minute."""


@pytest.fixture
def deadline() -> Iterator[None]:
    """Fails a test that hangs, wherever it hangs."""

    def expire(*_: object) -> None:
        pytest.fail(f"hangs for {HANGS:g} s")

    usual_handler = signal.signal(signal.SIGALRM, expire)
    signal.setitimer(signal.ITIMER_REAL, HANGS)
    yield
    signal.setitimer(signal.ITIMER_REAL, 0.0)
    signal.signal(signal.SIGALRM, usual_handler)


@pytest.fixture(autouse=True)
def _released() -> Iterator[None]:
    """An emergency stop of one test doesn't hold the next."""
    yield
    release_process()


@pytest.fixture
def config() -> RobotConfig:
    """The ACSAR robot, with the patience that a busy machine needs."""
    return RobotConfig.preset("acsar").with_(
        connect_timeout=20.0, feedback_timeout=5.0, watchdog_timeout=2.0
    )


@pytest.fixture
def robot_file(tmp_path: Path, config: RobotConfig) -> RobotFile:
    """`robot_file(field=value, ...)` writes the patient robot with changes to a YAML file."""

    def write(**changes: object) -> Path:
        path = tmp_path / "patient.yaml"
        path.write_text(yaml.safe_dump(config.with_(**changes).model_dump()), encoding="utf-8")
        return path

    return write


@pytest.fixture
def start_emulator(tmp_path: Path, pytestconfig: pytest.Config) -> Iterator[StartEmulator]:
    """`start_emulator("--silent", ...)` starts one. All of them end with the test."""
    running: list[Emulated] = []

    def begin(*arguments: str) -> Emulated:
        log = tmp_path / f"emulator{len(running)}.jsonl"
        running.append(start(log, *arguments, board=pytestconfig.getoption("board")))
        return running[-1]

    yield begin
    for emulated in running:
        emulated.end()


@pytest.fixture
def own_emulator(start_emulator: StartEmulator) -> Emulated:
    """A robot of the test's own: it may be unplugged, frozen, or asked where it started."""
    return start_emulator()


@pytest.fixture(scope="session")
def shared_emulator(
    tmp_path_factory: pytest.TempPathFactory, pytestconfig: pytest.Config
) -> Iterator[Emulated]:
    log = tmp_path_factory.mktemp("shared") / "emulator.jsonl"
    emulated = start(log, board=pytestconfig.getoption("board"))
    yield emulated
    emulated.end()


@pytest.fixture
def emulator(shared_emulator: Emulated) -> Emulated:
    """A robot at rest, wherever the last test left it, and an empty log."""
    shared_emulator.forget()
    return shared_emulator


@pytest.fixture
def shared_device(shared_emulator: Emulated) -> str:
    """The same robot's device, for tests that need no log."""
    return shared_emulator.device
