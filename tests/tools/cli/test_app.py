"""The command line: help, exit codes, recording and replay."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from cli_tools import assert_one_line
from policy_tools import save
from recording_tools import drive, make_bag, write_mcap
from serial_tools import RobotFile

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


def test_help_lists_all_commands(call: Any) -> None:
    out = call.succeed("--help")
    for name, command in COMMANDS.items():
        assert f"  {name} " in out
        assert (command.function.__doc__ or "").splitlines()[0] in out
    assert call() == (2, out, "")


def test_help_of_a_group_lists_its_commands(call: Any) -> None:
    out = call.succeed("worlds --help")
    listed = [line.split()[1] for line in out.splitlines() if line.startswith("  worlds ")]
    assert listed == ["show", "check", "convert"]
    assert "record info" not in out


def test_help_imports_nothing_heavy() -> None:
    command = [sys.executable, "-c", HEAVY, "worlds", "convert", "--help"]
    done = subprocess.run(command, check=True, capture_output=True, text=True)
    assert done.stderr == "\n"


@pytest.mark.parametrize(
    ("words", "typed", "meant"),
    [("drve /dev/ttyUSB0", "drve", "drive"), ("record infos", "record infos", "record info")],
)
def test_a_mistyped_command_is_one_line(words: str, typed: str, meant: str, call: Any) -> None:
    code, out, error = call(words)
    assert (code, out) == (2, "")
    assert_one_line(error, f"'{typed}': no such command; did you mean '{meant}'?")


def test_options_that_cannot_be_parsed_have_no_traceback(call: Any) -> None:
    code, _, error = call("emulate --body")
    assert code == 2
    assert error
    assert "Traceback" not in error


def test_record_on_a_full_disk_keeps_the_results(
    call: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*arguments: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("acsar_gym.recording.writer.RecordingWriter.flush", fail)
    figures = tmp_path / "figures.json"
    evaluate = f"evaluate --link planar --episodes 2 --json {figures} --record"
    with pytest.warns(RecordingWarning, match=r"tape.mcap: can't be written: No space left on"):
        code, out, error = call(evaluate, tmp_path / "tape.mcap")
    assert code == 2
    assert "2/2 (100.0%)" in out
    assert figures.exists()
    assert_one_line(error, "tape.mcap: the recording isn't whole")


def test_trust_is_needed_for_a_zip(tmp_path: Path, call: Any) -> None:
    model = save(tmp_path / "model.zip")
    out = tmp_path / "out.onnx"
    call.refuse("can run any code when it's loaded: pass --trust", f"policy {model} --out {out}")
    assert not out.exists()
    assert call(f"policy {model} --out {out} --trust")[2] == ""
    assert out.exists()


def test_replay_has_the_figures_of_the_recorded_run(
    robot_file: RobotFile, tmp_path: Path, call: Any
) -> None:
    def read(name: str) -> dict[str, Any]:
        data = json.loads((tmp_path / name).read_text(encoding="utf-8"))
        names = ("success_rate", "time_to_goal", "path", "smoothness", "ticks")
        return {key: data[key] for key in names}

    run = f"run 0.6 0.2 --robot {robot_file()} --json {tmp_path}"
    tape = tmp_path / "tape.mcap"
    out = call.succeed(f"{run}/live.json --link planar --record {tape}")
    assert "behind the wire" in out
    call.succeed(f"{run}/replay.json --link replay:{tape}")
    assert read("replay.json") == read("live.json")
    assert read("live.json")["ticks"] > 20


def test_bags_are_read_as_recordings(tmp_path: Path, call: Any) -> None:
    tape = drive(tmp_path / "tape.mcap", RobotConfig.preset("acsar"), 600)
    topics = {"/joint_states": "/joint_states", "/cmd_vel_sent": "/cmd_vel", "/scan": "/scan"}
    bag = write_mcap(tmp_path / "bag.mcap", make_bag(tape, topics))
    for line, result in (
        (f"record info {bag}", "1 episode, 6.0 s"),
        (f"record export {bag} --to csv", "ticks.csv"),
        (f"gap {bag}", "1 held-out episode"),
        (f"identify --from {bag}", "motor.time_constant"),
    ):
        out = call.succeed(line, "--robot", "acsar")
        assert result in out
    assert (tmp_path / "bag" / "ticks.csv").exists()

    for line, message in (
        (f"record info {bag}", "is a ROS 2 bag: name its robot with --robot PRESET|FILE"),
        (f"identify planar --from {bag}", "--from: give a device, or recordings with --from"),
        (f"gap {tape} --robot acsar --topics /robot1", "--topics is for ROS 2 bags"),
    ):
        call.refuse(message, line)
