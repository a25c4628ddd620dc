"""The command line: help, exit codes, recording and replay."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from bag_tools import make_bag, write_mcap
from cli_tools import Call, assert_one_line
from recording_tools import drive
from serial_tools import RobotFile
from zip_tools import poison, save

from acsar_gym import RobotConfig
from acsar_gym.errors import RecordingWarning
from acsar_gym.tools.cli import COMMANDS

pytestmark = pytest.mark.usefixtures("deadline")

HEAVY = """
import sys
from acsar_gym.tools.cli import app
sys.argv = ["acsar-gym", *sys.argv[1:]]
try:
    app.main()
finally:
    found = {"torch", "ray", "rerun", "pybullet", "numba"} & set(sys.modules)
    print(*sorted(found), file=sys.stderr)
"""


def test_help_lists_all_commands(call: Call) -> None:
    code, out, error = call("--help")
    assert (code, error) == (0, "")
    for name, command in COMMANDS.items():
        assert f"  {name} " in out
        assert (command.function.__doc__ or "").splitlines()[0] in out
    assert call() == (2, out, "")


@pytest.mark.parametrize("words", ["--help", "worlds convert --help"])
def test_help_imports_nothing_heavy(words: str) -> None:
    command = [sys.executable, "-c", HEAVY, *words.split()]
    done = subprocess.run(command, check=True, capture_output=True, text=True)
    assert done.stderr == "\n"


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("drve", "/dev/ttyUSB0"), "'drve': no such command; did you mean 'drive'?"),
        (("record", "infos"), "'record infos': no such command; did you mean 'record info'?"),
    ],
)
def test_a_mistyped_command_is_one_line(words: tuple[str, ...], message: str, call: Call) -> None:
    code, out, error = call(*words)
    assert (code, out) == (2, "")
    assert_one_line(error, message)


@pytest.mark.parametrize("words", ["run 1", "emulate --body"])
def test_options_that_cannot_be_parsed_have_no_traceback(words: str, call: Call) -> None:
    code, _, error = call(*words.split())
    assert code == 2
    assert error
    assert "Traceback" not in error


def test_record_on_a_full_disk_keeps_the_results(
    call: Call, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*arguments: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("acsar_gym.recording.writer.RecordingWriter.flush", fail)
    figures = tmp_path / "figures.json"
    evaluate = ("evaluate", "--link", "planar", "--episodes", "2")
    with pytest.warns(RecordingWarning, match=r"tape.mcap: can't be written: No space left on"):
        code, out, error = call(*evaluate, "--record", tmp_path / "tape.mcap", "--json", figures)
    assert code == 2
    assert "2/2 (100.0%)" in out
    assert figures.exists()
    assert_one_line(error, "tape.mcap: the recording isn't whole")


def test_trust_is_needed_for_a_zip(tmp_path: Path, call: Call) -> None:
    model = save(tmp_path / "model.zip")
    marker = tmp_path / "marker"
    bad = poison(model, "data", marker, tmp_path / "bad.zip")
    out = tmp_path / "out.onnx"
    code, _, error = call("policy", bad, "--out", out)
    assert code == 2
    assert_one_line(error, f"{bad}: a stable-baselines3 zip can run any code")
    assert "--trust" in error
    assert not marker.exists()
    assert not out.exists()
    assert call("policy", model, "--out", out, "--trust")[2] == ""
    assert out.exists()


def test_replay_has_the_figures_of_the_recorded_run(
    call: Call, robot_file: RobotFile, tmp_path: Path
) -> None:
    def read(name: str) -> dict[str, Any]:
        data = json.loads((tmp_path / name).read_text(encoding="utf-8"))
        names = ("success_rate", "time_to_goal", "path", "smoothness", "ticks")
        return {key: data[key] for key in names}

    run = ("run", "0.6", "0.2", "--robot", robot_file())
    tape = tmp_path / "tape.mcap"
    live = ("--link", "planar", "--record", tape, "--json", tmp_path / "live.json")
    code, out, error = call(*run, *live)
    assert (code, error) == (0, "")
    assert "behind the wire" in out
    replayed = ("--link", f"replay:{tape}", "--json", tmp_path / "replay.json")
    assert call(*run, *replayed)[::2] == (0, "")
    assert read("replay.json") == read("live.json")
    assert read("live.json")["ticks"] > 20


def test_view_saves_a_file_for_rerun(call: Call, tmp_path: Path) -> None:
    tape = drive(tmp_path / "tape.mcap", RobotConfig.of(None))
    out = tmp_path / "tape.rrd"
    for _ in range(2):  # replaces its own file
        code, text, error = call("view", tape, "--save", out)
        assert (code, error) == (0, "")
        assert text.startswith(f"{out}: 1 episode, ")
    out.write_text("mine", encoding="utf-8")
    assert call("view", tape, "--save", out)[0] == 2
    code, _, error = call("view", "planar", "--save", tmp_path / "new.rrd")
    assert code == 2
    assert_one_line(error, "planar")


def test_bags_are_read_as_recordings(call: Call, tmp_path: Path) -> None:
    tape = drive(tmp_path / "tape.mcap", RobotConfig.preset("acsar"), 600)
    topics = {"/joint_states": "/joint_states", "/cmd_vel_sent": "/cmd_vel", "/scan": "/scan"}
    bag = write_mcap(tmp_path / "bag.mcap", make_bag(tape, topics))
    results: list[tuple[tuple[str | Path, ...], str]] = [
        (("record", "info", bag), "1 episode, 6.0 s"),
        (("record", "export", bag, "--to", "csv"), "ticks.csv"),
        (("gap", bag), "1 held-out episode"),
        (("identify", "--from", bag), "motor.time_constant"),
    ]
    for command, result in results:
        code, out, error = call(*command, "--robot", "acsar")
        assert (code, error) == (0, "")
        assert result in out
    assert (tmp_path / "bag" / "ticks.csv").exists()

    errors: list[tuple[tuple[str | Path, ...], str]] = [
        (("record", "info", bag), "is a ROS 2 bag: name its robot with --robot PRESET|FILE"),
        (("identify", "planar", "--from", bag), "--from: give a device, or recordings with --from"),
        (("gap", tape, "--robot", "acsar", "--topics", "/robot1"), "--topics is for ROS 2 bags"),
    ]
    for command, message in errors:
        code, _, error = call(*command)
        assert code == 2
        assert_one_line(error, message)
