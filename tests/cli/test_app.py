"""The command line: errors, exit codes, help, recording and replay."""

from __future__ import annotations

import json
import shlex
import subprocess
from pathlib import Path
from typing import Any

import pytest
from cli_tools import Call, assert_one_line
from recording_tools import drive
from serial_tools import CLI, TIMEOUT, RobotFile, cli
from zip_tools import PLACES, poison, save

from acsar_gym import RobotConfig
from acsar_gym.errors import LateTicksError, RecordingWarning
from acsar_gym.tools.cli import COMMANDS

pytestmark = [pytest.mark.anywhere, pytest.mark.usefixtures("deadline")]

MISSING = "/dev/acsar-missing"
HUGE = str(10**400)
RUN = ("run", "1", "0", "--link", "planar")
SOCKET = ("run", "1", "0", "--link", "socket://127.0.0.1:1")


@pytest.mark.parametrize(
    ("arguments", "status", "said"),
    [
        (("run", "1", "0", "--link", "bulet"), 2, "did you mean 'bullet'?"),
        (("run", "1", "0", "--link", "serial", "--yes"), 2, "serial_port"),
        ((*SOCKET, "--yes"), 3, "socket://127.0.0.1:1"),
        (SOCKET, 2, "no terminal to ask on; add --yes"),
        (("doctor", MISSING, "--spin"), 2, "no terminal to ask on; add --yes"),
        (("run", "1", "0", "--link", "replay:missing.mcap"), 2, "missing.mcap"),
        (("run", "50", "0", "--link", "planar"), 2, "0.5 to 3 m"),
        (("run", "nan", "0", "--link", "planar"), 2, "goal"),
        ((*RUN, "--robot", "acsr"), 2, "did you mean 'acsar'?"),
        ((*RUN, "--robot", "missing.yaml"), 2, "missing.yaml"),
        ((*RUN, "--policy", "missing.onnx"), 2, "missing.onnx: no such policy file"),
        ((*RUN, "--record", "/missing/tape.mcap"), 2, "can't be written"),
        ((*RUN, "--json", "/missing/figures.json"), 2, "can't be written"),
        (("evaluate", "--link", "planar", "--episodes", "0"), 2, "--episodes"),
        (("evaluate", "--link", "planar", "--episodes", HUGE), 2, "must be 1 to 1,000,000"),
        (("evaluate", "--link", "planar", "--seed", HUGE), 2, "must be 0 to 2^63 - 1"),
        (("evaluate", "--link", "planar", "--seed", "-1"), 2, "--seed -1"),
        (("evaluate", "--link", MISSING, "--episodes", "1"), 3, f"{MISSING}: no such device"),
        (("evaluate", "--policy", "pint_goal"), 2, "point_goal"),
        (("evaluate", "--late-share", "2", "--link", "planar"), 2, "late_share = 2.0"),
        (("evaluate", "--cores", "4095"), 2, "cores = 4095: this process may use"),
        (("doctor", MISSING, "--timing"), 3, f"{MISSING}: no such device"),
        (("doctor", "--timing"), 2, "--timing needs a device"),
        (("doctor", MISSING, "--timing", "--duration", "0"), 2, "duration = 0.0"),
        (("doctor", MISSING, "--timing", "--duration", "1e300"), 2, "duration = 1e+300"),
        (("run", "1", "0", "--realtime", "99"), 2, "real-time priority = 99: must be 1 to 98"),
        (("drive", "--link", "planar", "--linear", "nan"), 2, "finite"),
        (("drive", "--link", MISSING, "--linear", "0.1"), 3, f"{MISSING}: no such device"),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, tuple) else "",
)
def test_errors_are_one_line_and_an_exit_code(
    arguments: tuple[str, ...], status: int, said: str, call: Call
) -> None:
    code, _, error = call(*arguments)
    assert code == status, error
    assert_one_line(error, said)


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (("evaluate", "--link", "planar", "--episodes", "2"), "2/2 (100.0%)"),
        (RUN, "1/1 (100.0%)"),
        (("calibrate", "planar", "straight"), "left_wheel_radius_multiplier"),
        (("identify", "planar", "--duration", "12"), "motor.time_constant"),
        (("drive", "--link", "planar", "--linear", "0.1", "--duration", "0.1"), "feedback"),
    ],
    ids=lambda value: value[0] if isinstance(value, tuple) else "",
)
def test_results_survive_a_full_disk(
    arguments: tuple[str, ...],
    said: str,
    call: Call,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def fail(*arguments: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("acsar_gym.recording.sinks.McapFile.add", fail)
    figures, tape = tmp_path / "figures.json", tmp_path / "tape.mcap"
    more = () if arguments[0] == "drive" else ("--json", figures)
    with pytest.warns(RecordingWarning, match=r"tape.mcap: can't be written: No space left on"):
        code, out, error = call(*arguments, "--record", tape, *more)
    assert code == 2
    assert said in out
    assert figures.exists() == bool(more)
    assert_one_line(error, "tape.mcap: the recording isn't whole")


@pytest.mark.parametrize(
    ("arguments", "status", "said"),
    [
        (("run", "1", "0", "--link", MISSING, "--yes"), 3, f"{MISSING}: no such device"),
        ((*RUN, "--policy", "missing.onnx"), 2, "missing.onnx: no such policy file"),
        (("emulate", "--body", "balloon"), 2, "planar or bullet"),
    ],
    ids=["device", "policy", "body"],
)
def test_errors_of_a_real_process(arguments: tuple[str, ...], status: int, said: str) -> None:
    done = subprocess.run(
        [*CLI, *arguments], check=False, capture_output=True, text=True, timeout=TIMEOUT
    )
    assert done.returncode == status, done.stderr
    assert_one_line(done.stderr, said)


@pytest.mark.parametrize("content", [b"", b"not ONNX", bytes(range(256)) * 8])
def test_a_broken_policy_file_is_one_line(content: bytes, tmp_path: Path, call: Call) -> None:
    policy = tmp_path / "broken.onnx"
    policy.write_bytes(content)
    code, _, error = call(*RUN, "--policy", policy)
    assert code == 2
    assert_one_line(error, f"{policy}: ")


@pytest.fixture(scope="module")
def model(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A stable-baselines3 zip for PointGoal."""
    return save(tmp_path_factory.mktemp("model") / "model.zip")


@pytest.mark.parametrize("place", PLACES)
@pytest.mark.parametrize(
    "command", [(*RUN, "--policy"), ("evaluate", "--policy"), ("export",)], ids=lambda c: c[0]
)
def test_an_untrusted_zip_runs_nothing_and_is_one_line(
    command: tuple[str, ...], place: str, model: Path, tmp_path: Path, call: Call
) -> None:
    marker, out = tmp_path / "marker", tmp_path / "policy.onnx"
    bad = poison(model, place, marker, tmp_path / "model.zip")
    code, _, error = call(*command, bad, *([out] if command == ("export",) else []))
    assert code == 2
    assert_one_line(error, f"{bad}: a stable-baselines3 zip can run any code")
    assert "--trust" in error
    assert not marker.exists()
    assert not out.exists()


def test_a_trusted_zip_is_evaluated_run_and_exported(
    model: Path, tmp_path: Path, call: Call
) -> None:
    out, by_zip, by_onnx = (tmp_path / name for name in ("policy.onnx", "zip.json", "onnx.json"))
    code, said, error = call("export", model, out, "--trust")
    assert (code, said, error) == (0, f"written: {out}\n", "")
    assert call(*RUN, "--policy", model, "--trust")[2] == ""
    drive = ("evaluate", "--link", "planar", "--episodes", "2", "--policy")
    assert call(*drive, model, "--trust", "--json", by_zip)[::2] == (0, "")
    assert call(*drive, out, "--json", by_onnx)[::2] == (0, "")
    path_of = [json.loads(file.read_text())["path"] for file in (by_zip, by_onnx)]
    assert path_of[0] == pytest.approx(path_of[1], abs=1e-3)


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (("--env", "maze"), "Maze"),
        (("--env", "path_follow"), "in acsar_gym/PathFollow-v0: train"),
        (("--robot", "acsr"), "did you mean 'acsar'?"),
    ],
    ids=["environment", "observation", "robot"],
)
def test_a_zip_that_cannot_be_exported_is_one_line(
    arguments: tuple[str, ...], said: str, model: Path, tmp_path: Path, call: Call
) -> None:
    code, _, error = call("export", model, tmp_path / "policy.onnx", "--trust", *arguments)
    assert code == 2
    assert_one_line(error, said)


def test_export_says_where_it_cannot_write(model: Path, call: Call) -> None:
    code, _, error = call("export", model, "/missing/policy.onnx", "--trust")
    assert code == 2
    assert_one_line(error, "can't be written")


@pytest.mark.parametrize(
    "content",
    ["", "{}", "[]", "nonsense", '{"reset": "x"}', '{"reset": 0}\n{"t": 1}', "\xe9"],
)
def test_a_broken_recording_is_one_line(content: str, tmp_path: Path, call: Call) -> None:
    tape = tmp_path / "tape.jsonl"
    tape.write_text(content + "\n", encoding="utf-8")
    code, _, error = call("run", "1", "0", "--link", f"replay:{tape}")
    assert code == 2
    assert_one_line(error, f"{tape}: ")


def test_help_lists_all_subcommands() -> None:
    done = cli("--help")
    assert (done.returncode, done.stderr) == (0, "")
    listed = {line.split("•")[1].split()[0] for line in done.stdout.splitlines() if "•" in line}
    assert listed == set(COMMANDS)


@pytest.mark.parametrize("arguments", [(), ("dance",), ("run", "1"), ("emulate", "--body")])
def test_a_command_line_that_cannot_be_read(arguments: tuple[str, ...], call: Call) -> None:
    code, _, error = call(*arguments)
    assert code == 2
    assert error
    assert "Traceback" not in error


def figures(path: Path) -> dict[str, Any]:
    """The figures of a run that odometry and the clock know."""
    data: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
    assert data["ticks"] > 20
    known = ("success_rate", "time_to_goal", "path", "smoothness", "ticks")
    return {key: data[key] for key in known}


@pytest.mark.parametrize(
    "kind", ["planar", "bullet", pytest.param("serial", marks=pytest.mark.xdist_group("serial"))]
)
def test_a_recorded_run_replays_with_the_same_figures(
    kind: str, call: Call, request: pytest.FixtureRequest, robot_file: RobotFile, tmp_path: Path
) -> None:
    link = request.getfixturevalue("shared_device") if kind == "serial" else kind
    tape, live, replayed = (tmp_path / name for name in ("tape.mcap", "live.json", "replay.json"))
    to_goal = ("run", "0.6", "0.2", "--yes", "--robot", robot_file())
    code, out, error = call(*to_goal, "--link", link, "--record", tape, "--json", live)
    assert code == LateTicksError.exit_code or not error
    assert "behind the wire" in out
    again, _, same = call(*to_goal, "--link", f"replay:{tape}", "--json", replayed)
    assert (again, same) == (code, error)
    assert figures(replayed) == figures(live)


def test_a_recording_of_another_run_ends_early(call: Call, tmp_path: Path) -> None:
    tape = tmp_path / "tape.mcap"
    call("run", "0.6", "0.2", "--link", "planar", "--record", tape)
    code, _, error = call("run", "-1.5", "2.0", "--link", f"replay:{tape}")
    assert code == 3
    assert_one_line(error, f"{tape}: other commands than recorded, tick ")


def test_a_disk_that_is_full_is_one_line(call: Call) -> None:
    code, _, error = call(*RUN, "--record", "/dev/full")
    assert code == 2
    assert error.strip() == "acsar-gym: /dev/full: can't be written: No space left on device"


def test_an_evaluation_keeps_every_episode(call: Call, tmp_path: Path) -> None:
    file = tmp_path / "figures.json"
    code, out, _ = call("evaluate", "--link", "planar", "--episodes", "2", "--json", file)
    assert code == 0
    assert "\npoint_goal, seeds 0 to 1, worlds: none" in out
    assert "95 % intervals: point_goal, seeds 0 to 1, worlds: none" in " ".join(out.split())
    figures = json.loads(file.read_text())
    assert figures["header"]["link"] == "planar"
    assert figures["invalid"] == 0
    assert len(figures["per_episode"]) == 2
    assert figures["per_episode"][0]["timing"] is None


def test_the_doctor_tells_how_late_ticks_are(
    call: Call, shared_device: str, robot_file: RobotFile, tmp_path: Path
) -> None:
    file = tmp_path / "timing.json"
    options = ("--robot", robot_file(), "--timing", "--duration", "0.1", "--json", file)
    code, output, _ = call("doctor", shared_device, *options)
    assert code == 0
    for word in ("lateness", "bare loop", "feedback age", "baud rate"):
        assert word in output
    assert json.loads(file.read_text())["lateness"]["ticks"] == 50


def test_a_closed_pipe_is_no_traceback(tmp_path: Path) -> None:
    drive(tmp_path / "a.mcap", RobotConfig.preset("acsar"), 5)
    line = f"{shlex.join([*CLI, 'record', 'info', str(tmp_path / 'a.mcap')])} | true"
    done = subprocess.run(
        ["bash", "-c", f"set -o pipefail; {line}"],
        check=False,
        capture_output=True,
        text=True,
        timeout=TIMEOUT,
    )
    assert done.stderr == ""
    assert done.returncode == 128 + 13
