"""The command line: help, completion, exit codes, recording and replay."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from bag_tools import make_bag, write_mcap
from cli_tools import Call, assert_one_line
from recording_tools import drive
from serial_tools import RobotFile, cli
from zip_tools import poison, save

from acsar_gym import RobotConfig
from acsar_gym.errors import LateTicksError, RecordingWarning
from acsar_gym.tools.cli import COMMANDS

pytestmark = pytest.mark.usefixtures("deadline")


RUN = ("run", "1", "0", "--link", "planar")


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (("evaluate", "--link", "planar", "--episodes", "2"), "2/2 (100.0%)"),
        (RUN, "1/1 (100.0%)"),
        (("identify", "planar", "--duration", "12"), "motor.time_constant"),
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

    monkeypatch.setattr("acsar_gym.recording.writer.RecordingWriter.flush", fail)
    figures, tape = tmp_path / "figures.json", tmp_path / "tape.mcap"
    with pytest.warns(RecordingWarning, match=r"tape.mcap: can't be written: No space left on"):
        code, out, error = call(*arguments, "--record", tape, "--json", figures)
    assert code == 2
    assert said in out
    assert figures.exists()
    assert_one_line(error, "tape.mcap: the recording isn't whole")


@pytest.mark.parametrize("command", [(*RUN, "--policy"), ("evaluate", "--policy"), ("policy",)])
def test_only_a_trusted_zip_runs(command: tuple[str, ...], tmp_path: Path, call: Call) -> None:
    model, marker, out = save(tmp_path / "model.zip"), tmp_path / "marker", tmp_path / "out.onnx"
    bad = poison(model, "data", marker, tmp_path / "bad.zip")
    more = ["--out", out] if command == ("policy",) else []
    code, _, error = call(*command, bad, *more)
    assert code == 2
    assert_one_line(error, f"{bad}: a stable-baselines3 zip can run any code")
    assert "--trust" in error
    assert not marker.exists()
    assert not out.exists()
    seen = () if "evaluate" not in command else ("--link", "planar", "--episodes", "1")
    assert call(*command, model, *more, "--trust", *seen)[2] == ""
    assert out.exists() == bool(more)


def test_help_lists_all_subcommands() -> None:
    done = cli("--help")
    assert (done.returncode, done.stderr) == (0, "")
    listed = {line.split("•")[1].split()[0] for line in done.stdout.splitlines() if "•" in line}
    assert listed == {name.split()[0] for name in COMMANDS}


def test_a_command_that_is_mistyped_is_one_line(call: Call) -> None:
    code, out, error = call("drve", "/dev/ttyUSB0")
    assert (code, out) == (2, "")
    assert_one_line(error, "'drve': no such command; did you mean 'drive'?")


def figures(path: Path) -> dict[str, Any]:
    """The figures of a run that odometry and the clock know."""
    data: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
    assert data["ticks"] > 20
    known = ("success_rate", "time_to_goal", "path", "smoothness", "ticks")
    return {key: data[key] for key in known}


@pytest.mark.parametrize("kind", ["planar", "bullet", "serial"])
def test_a_recorded_run_replays_with_the_same_figures(
    kind: str, call: Call, request: pytest.FixtureRequest, robot_file: RobotFile, tmp_path: Path
) -> None:
    link = request.getfixturevalue("shared_device") if kind == "serial" else kind
    tape, live, replayed = (tmp_path / name for name in ("tape.mcap", "live.json", "replay.json"))
    to_goal = ("run", "0.6", "0.2", "--yes", "--robot", robot_file())
    code, out, error = call(*to_goal, "--link", link, "--record", tape, "--json", live)
    assert code == LateTicksError.exit_code or not error
    assert "behind the wire" in out
    again, _, replay_error = call(*to_goal, "--link", f"replay:{tape}", "--json", replayed)
    assert (again, replay_error) == (0, "")  # late ticks or not: nobody can mend what was recorded
    assert figures(replayed) == figures(live)


def test_a_recording_becomes_a_file_for_rerun(call: Call, tmp_path: Path) -> None:
    tape, out = drive(tmp_path / "tape.mcap", RobotConfig.of(None)), tmp_path / "tape.rrd"
    for _ in range(2):  # replaces what it wrote itself
        code, said, error = call("view", tape, "--save", out)
        assert (code, error) == (0, "")
        assert said.startswith(f"{out}: 1 episode, ")
    out.write_text("mine", encoding="utf-8")
    code, _, error = call("view", tape, "--save", out)
    assert code == 2
    assert_one_line(error, f"{out}: ")
    for wrong in ("planar", tmp_path / "none.mcap"):
        code, _, error = call("view", wrong, "--save", tmp_path / "new.rrd")
        assert code == 2
        assert_one_line(error, str(wrong))


def test_bags_are_read_where_recordings_are(call: Call, tmp_path: Path) -> None:
    tape = drive(tmp_path / "tape.mcap", RobotConfig.preset("acsar"), 600)
    topics = {"/joint_states": "/joint_states", "/cmd_vel_sent": "/cmd_vel", "/scan": "/scan"}
    bag = write_mcap(tmp_path / "bag.mcap", make_bag(tape, topics))
    code, out, error = call("record", "info", bag, "--robot", "acsar")
    assert (code, error) == (0, "")
    assert "1 episode, 6.0 s" in out
    code, _, error = call("record", "info", bag)
    assert code == 2
    assert_one_line(error, f"{bag}: is a ROS 2 bag: name its robot with --robot PRESET|FILE")
    code, _, error = call("record", "export", bag, "--to", "csv", "--robot", "acsar")
    assert (code, error) == (0, "")
    assert (tmp_path / "bag" / "ticks.csv").exists()
    code, out, error = call("gap", bag, "--robot", "acsar")
    assert (code, error) == (0, "")
    assert "1 held-out episode" in out
    code, out, error = call("identify", "--from", bag, "--robot", "acsar")
    assert (code, error) == (0, "")
    assert "motor.time_constant" in out
    code, _, error = call("identify", "planar", "--from", bag)
    assert code == 2
    assert_one_line(error, "--from: give a device, or recordings with --from, not both")
    code, _, error = call("gap", tape, "--robot", "acsar", "--topics", "/robot1")
    assert code == 2
    assert_one_line(error, f"{tape}: --topics is for ROS 2 bags; this is a recording")


TYPED = """
source "$1"; shift
COMP_WORDS=("$@")
COMP_CWORD=$(($# - 1))
_tyro_acsar_gym
printf '%s\\n' "${COMPREPLY[@]}"
"""
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


@pytest.mark.parametrize("shell", ["bash", "zsh", "fish"])
def test_a_script_for_each_shell_knows_every_command(call: Call, shell: str) -> None:
    code, script, error = call("completion", shell)
    assert (code, error) == (0, "")
    assert [name for name in COMMANDS if name.split()[-1] not in script] == []
    assert "learning-rate" in script
    assert "difficulty" in script  # of worlds show


@pytest.mark.skipif(shutil.which("bash") is None, reason="no bash")
@pytest.mark.parametrize(
    ("words", "completed"),
    [
        (("ev",), ["evaluate"]),
        (("worlds", "ch"), ["check"]),
        (("train", "--lear"), ["--learning-rate"]),
        (("record", "export", "drive.mcap", "--to", "p"), ["parquet"]),
        (("worlds", "show", "--diff"), ["--difficulty"]),
        (("nosuch", "x"), []),
    ],
)
def test_bash_completes(
    call: Call, tmp_path: Path, words: tuple[str, ...], completed: list[str]
) -> None:
    file = tmp_path / "acsar-gym"
    file.write_text(call("completion", "bash")[1])
    command = ["bash", "-c", TYPED, "bash", str(file), "acsar-gym", *words]
    said = subprocess.run(command, check=True, capture_output=True, text=True).stdout
    assert said.split() == completed


@pytest.mark.parametrize(
    ("words", "found"),
    [("--help", "\n"), ("worlds convert --help", "\n"), ("completion bash", "\n")],
)
def test_it_imports_nothing_heavy(words: str, found: str) -> None:
    command = [sys.executable, "-c", HEAVY, *words.split()]
    done = subprocess.run(command, check=True, capture_output=True, text=True)
    assert done.stderr == found
