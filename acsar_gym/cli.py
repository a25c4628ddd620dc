"""`acsar-gym`: one command, subcommands, no logic.

Exit codes: 0 all well, 1 a check or run failed, 2 a bad argument, config or file, 3 the link, 130
interrupted.
"""

from __future__ import annotations

import io
import signal
import sys
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any

import tyro

import acsar_gym
from acsar_gym.config import RobotConfig
from acsar_gym.errors import AcsarError, ConfigError, SafetyWarning, printable, shown

Json = Annotated[Path | None, tyro.conf.arg(metavar="FILE")]
File = Json
Seconds = Annotated[float | None, tyro.conf.arg(metavar="SECONDS")]
Source = Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="KIND|PATH")]
OutFile = Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="OUT")]
Worlds = Annotated[str | None, tyro.conf.arg(metavar="KIND|PATH")]
LidarArg = Annotated[str | None, tyro.conf.arg(metavar="URL")]
Priority = Annotated[int | None, tyro.conf.arg(metavar="PRIORITY")]
Kinds = Annotated[tuple[str, ...] | None, tyro.conf.arg(metavar="KIND [KIND ...]")]
Cores = Annotated[tuple[int, ...] | None, tyro.conf.arg(metavar="N [N ...]")]
MOST_COUNT = 10**9
"""Of what a command counts: steps, episodes."""
FORMAT = warnings.formatwarning
EnvArg = Annotated[str, tyro.conf.arg(metavar="KIND|ID")]
RobotArg = Annotated[str | None, tyro.conf.arg(metavar="PRESET|FILE")]


def demo(
    steps: int = 600_000,
    episodes: int = 100,
    serial_episodes: int = 16,
    out: Path = Path("runs/demo"),
    json: Json = None,
) -> int:
    """Train a policy, drive it in PyBullet, then over a serial device; print one table.

    Args:
        steps: env steps of training.
        episodes: episodes in PyBullet.
        serial_episodes: episodes over the emulator's tty, in real time.
        out: folder for the policy and the logs.
        json: write the table's figures here too.
    """
    from acsar_gym import demo as demos  # noqa: PLC0415
    from acsar_gym.evaluation import report  # noqa: PLC0415

    report.check_writable(json)
    counts = {"--steps": steps, "--episodes": episodes, "--serial-episodes": serial_episodes}
    for name, count in counts.items():
        if not 1 <= count <= MOST_COUNT:
            raise ConfigError(f"{name} = {shown(count)}: must be 1 to {MOST_COUNT:,}")
    report.make_folder(out)
    runs = demos.run(steps, episodes, serial_episodes, out)
    rows = [(name, run.summary) for name, run in runs]
    title = f"One policy file, {out / 'policy.onnx'}, worlds: {runs[0][1].worlds}"
    report.show(report.summary_table(title, rows))
    report.write_json(json, {name: run.as_dict() for name, run in runs})
    return 0 if all(summary.success_rate >= 0.95 for _, summary in rows) else 1


def bench(json: Json = None, plots: File = None) -> int:
    """Measure env, wire and engine side by side.

    Args:
        json: write the figures here too.
        plots: folder for plots of the planar robot against PyBullet's.
    """
    from acsar_gym.bench import comparison  # noqa: PLC0415
    from acsar_gym.bench import env as benchmark  # noqa: PLC0415
    from acsar_gym.evaluation import report  # noqa: PLC0415

    report.check_writable(json)
    figures = benchmark.measure()
    report.show(benchmark.table(figures))
    report.write_json(json, {f"{f.name} [{f.unit}]": f.value for f in figures})
    for file in comparison.plot(plots, RobotConfig.of(None)) if plots else ():
        print(printable(f"drawn: {file}"))
    return 0


def emulate(
    robot: RobotArg = None,
    body: str = "planar",
    log: File = None,
    duration: Seconds = None,
    silent: bool = False,
    world: Worlds = None,
    lidar: bool = False,
    name: File = None,
) -> int:
    """Run the microcontroller's twin on a pseudo-terminal and print its device path.

    SIGUSR1 pulls the cable, SIGUSR2 plugs it in again as another device.

    Args:
        robot: preset or config file of the emulated robot.
        body: physics behind it, planar or bullet.
        log: write commands and true poses here, one JSON line each.
        duration: seconds to run; without it, until Ctrl-C.
        silent: never answer, as a board without power.
        world: where the robot stands: a file, or a generated world like clutter:7-7.
        lidar: emulate an RPLIDAR on a pseudo-terminal of its own, too.
        name: symbolic link to the device, wherever it is plugged in.
    """
    from acsar_gym.emulation.board import Emulator  # noqa: PLC0415
    from acsar_gym.worlds.pool import Pool  # noqa: PLC0415
    from acsar_gym.worlds.search import footprint_radius  # noqa: PLC0415

    config = RobotConfig.of(robot)
    places = None if world is None else Pool.of(world, None, footprint_radius(config), 1)
    place = next(iter(places)) if places else None
    ended: list[int] = []  # an exception from a signal's handler may be swallowed
    signal.signal(signal.SIGTERM, lambda number, _: ended.append(number))
    with Emulator(
        config, body=body, log=log, silent=silent, world=place, sees=lidar, name=name
    ) as emulator:
        for number, plugged in ((signal.SIGUSR1, False), (signal.SIGUSR2, True)):
            signal.signal(number, lambda *_, to=plugged: setattr(emulator, "plugged", to))
        print(f"serving a robot on {emulator.device}", flush=True)
        if lidar:
            print(f"serving a LiDAR on {emulator.lidar_device}", flush=True)
        emulator.run(duration, until=lambda: bool(ended))
    return 0


def doctor(
    device: Annotated[str | None, tyro.conf.Positional, tyro.conf.arg(metavar="DEVICE")] = None,
    robot: RobotArg = None,
    baud_rate: int | None = None,
    spin: bool = False,
    timing: bool = False,
    duration: float = 10.0,
    stopping: bool = False,
    trials: int = 100,
    kinds: Kinds = None,
    realtime: Priority = None,
    cores: Cores = None,
    json: Json = None,
) -> int:
    """List the serial ports, examine one, and say what to fix.

    Args:
        device: serial device to open; without it, ports are only listed.
        robot: preset or config file.
        baud_rate: instead of the robot's own.
        spin: turn the wheels to measure the round trip and the command time-out: lift the robot!
        timing: how late the control loop's ticks are, against a bare loop, and what to change.
        duration: of the timing [s].
        stopping: how soon an emulated robot is commanded to stop, whatever happens to its driver.
        trials: of each kind of fault, for --stopping.
        kinds: of faults, for --stopping: all unless some are named, as kill, stop, watchdog.
        realtime: SCHED_FIFO priority, 1 to 98.
        cores: numbers of the cores to run on.
        json: write the findings here too.
    """
    from acsar_gym.doctor import checks as doctors  # noqa: PLC0415
    from acsar_gym.doctor import host as urgency  # noqa: PLC0415
    from acsar_gym.evaluation import report  # noqa: PLC0415

    config = RobotConfig.of(robot)
    if baud_rate is not None:
        config = config.with_(baud_rate=baud_rate)
    device = device or config.serial_port
    report.check_writable(json)
    urgency.prepare(realtime, cores)
    if stopping:
        return _stopping(config, trials, kinds, json)
    if timing:
        return _timing(device, config, duration, json)
    checks = [doctors.port_list(), doctors.emergency_stop()]
    if device is not None:
        checks += doctors.examine(device, config, spin=spin)
    report.show(doctors.table(checks))
    report.write_json(json, doctors.as_json(checks))
    return 1 if any(check.status == "fail" for check in checks) else 0


def _stopping(
    config: RobotConfig, trials: int, kinds: tuple[str, ...] | None, json: Path | None
) -> int:
    from acsar_gym.doctor import stopping  # noqa: PLC0415
    from acsar_gym.evaluation import report  # noqa: PLC0415

    stops = stopping.measure_visibly(trials, kinds, config)
    report.show(stopping.table(stops))
    report.write_json(json, stopping.as_json(stops))
    return 0 if all(one.sound for one in stops) else 1


def _timing(device: str | None, config: RobotConfig, duration: float, json: Path | None) -> int:
    from acsar_gym.doctor import timing as doctor_timing  # noqa: PLC0415
    from acsar_gym.evaluation import report  # noqa: PLC0415

    found = doctor_timing.examine(device, config, duration)
    report.show(*found.tables())
    report.write_json(json, found.as_dict())
    return 0


def drive(
    link: str = "bullet",
    robot: RobotArg = None,
    linear: float | None = None,
    angular: float | None = None,
    duration: Seconds = None,
    window: bool = False,
    realtime: Priority = None,
    cores: Cores = None,
) -> int:
    """Drive with the keyboard, or hold a fixed twist, over any link.

    Args:
        link: bullet, planar, or a serial device.
        robot: preset or config file.
        linear: fixed linear speed, at most the robot's max_linear [m/s].
        angular: fixed angular speed, at most the robot's max_angular [rad/s].
        duration: seconds to hold the fixed twist; without it, until Ctrl-C.
        window: open PyBullet's window.
        realtime: SCHED_FIFO priority, 1 to 98.
        cores: numbers of the cores to run on.
    """
    from acsar_gym import teleop  # noqa: PLC0415
    from acsar_gym.doctor import host as urgency  # noqa: PLC0415
    from acsar_gym.links import open_link  # noqa: PLC0415
    from acsar_gym.robot import Robot  # noqa: PLC0415

    config = RobotConfig.of(robot)
    driver = Robot(open_link(link, config, window=window, realtime=True), config)
    urgency.prepare(realtime, cores)
    if linear is None and angular is None:
        teleop.keyboard(driver)
    else:
        teleop.fixed(driver, linear or 0.0, angular or 0.0, duration)
    return 0


def train() -> int:
    """Train PPO and export the policy: agents/train.py, with its own options."""
    from acsar_gym.resources import agent  # noqa: PLC0415

    return int(agent("train").main(sys.argv[2:]))


def evaluate(
    policy: str = "point_goal",
    link: str = "bullet",
    robot: RobotArg = None,
    episodes: int = 100,
    seed: int = 0,
    worlds: Worlds = None,
    in_order: bool = False,
    difficulty: float | None = None,
    lidar: LidarArg = None,
    trust: bool = False,
    env: EnvArg = "",
    late_share: float = 0.01,
    realtime: Priority = None,
    cores: Cores = None,
    json: Json = None,
) -> int:
    """Run a policy for some episodes behind any link and print what it reached.

    Args:
        policy: ONNX file, the name of a policy that comes along, or a function: mine.py:act.
        link: bullet, planar, or a serial device.
        robot: preset or config file.
        episodes: how many.
        seed: of the first episode; the next ones count up.
        worlds: instead of the test split: rooms:test, barn:1000-1099, ..., a file, or a folder.
        in_order: every world once, instead of drawing them: a benchmark on a folder of worlds.
        difficulty: of generated worlds, 0 to 1.
        lidar: rplidar:///dev/ttyUSB1 on hardware.
        trust: let a stable-baselines3 zip as policy run its code: your own, or whose you trust.
        env: what the policy is for, instead of the environment that it names itself.
        late_share: an episode of which more ticks were late is marked as invalid.
        realtime: SCHED_FIFO priority, 1 to 98.
        cores: numbers of the cores to run on.
        json: write the figures and every episode here too.
    """
    from acsar_gym.doctor import host as urgency  # noqa: PLC0415
    from acsar_gym.evaluation import report, runs  # noqa: PLC0415

    report.check_writable(json)
    urgency.prepare(realtime, cores)
    options = {"worlds": worlds, "difficulty": difficulty, "lidar": lidar}
    how = {"in_order": in_order, "late_share": late_share}
    done = runs.evaluate(
        policy, link, robot, episodes, seed, trust=trust, env=env, how=how, **options
    )
    title = f"{policy}, seeds {seed} to {seed + episodes - 1}, worlds: {done.worlds}"
    summary = done.summary
    report.show(report.summary_table(title, [(link, summary)]))
    report.show(report.interval_table(title, summary))
    report.write_json(json, done.as_dict())
    return 0


def run(
    goal: Annotated[tuple[float, float], tyro.conf.Positional, tyro.conf.arg(metavar="X Y")],
    policy: str = "point_goal",
    link: str = "bullet",
    robot: RobotArg = None,
    lidar: LidarArg = None,
    record: File = None,
    trust: bool = False,
    env: EnvArg = "",
    realtime: Priority = None,
    cores: Cores = None,
    json: Json = None,
) -> int:
    """Drive a policy to one goal (x y, in m, from where the robot stands).

    Args:
        goal: x and y in the odometry frame [m]: x ahead, y to the left.
        policy: ONNX file, the name of a policy that comes along, or a function: mine.py:act.
        link: bullet, planar, or a serial device.
        robot: preset or config file.
        lidar: rplidar:///dev/ttyUSB1 on hardware, for a policy that needs one.
        record: write everything on the wire here; replay it with --link replay:FILE.
        trust: let a stable-baselines3 zip as policy run its code: your own, or whose you trust.
        env: what the policy is for, instead of the environment that it names itself.
        realtime: SCHED_FIFO priority, 1 to 98.
        cores: numbers of the cores to run on.
        json: write the figures here too.
    """
    from acsar_gym.doctor import host as urgency  # noqa: PLC0415
    from acsar_gym.evaluation import report, runs  # noqa: PLC0415

    report.check_writable(json)
    urgency.prepare(realtime, cores)
    done = runs.to_goal(policy, link, robot, goal, record, trust=trust, env=env, lidar=lidar)
    title = f"{policy} to ({goal[0]:g}, {goal[1]:g}), worlds: {done.worlds}"
    report.show(report.summary_table(title, [(link, done.summary)]))
    report.write_json(json, done.as_dict())
    return 0 if done.results[0].success else 1


def export(
    model: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="MODEL")],
    out: OutFile,
    trust: bool = False,
    env: EnvArg = "",
    robot: RobotArg = None,
    vecnormalize: Annotated[str | None, tyro.conf.arg(metavar="FILE|none")] = None,
) -> int:
    """Convert a stable-baselines3 zip to an ONNX policy, which runs no code when it's loaded.

    Args:
        model: zip of PPO, A2C, SAC, TD3 or DDPG.
        out: the ONNX file.
        trust: let the zip run its code: only your own, or whose you trust.
        env: what it was trained for, such as point_goal; models of 'acsar-gym train' know it.
        robot: preset or config file of the robot that it was trained on.
        vecnormalize: statistics of the VecNormalize that it was trained with; run as code, too.
    """
    from acsar_gym.evaluation import report, runs  # noqa: PLC0415

    report.check_writable(out)
    runs.export(model, out, env, robot, trust=trust, vecnormalize=vecnormalize)
    print(printable(f"written: {out}"))
    return 0


def show(
    source: Source,
    out: Path = Path("worlds.png"),
    columns: int = 4,
    size: int = 320,
    difficulty: float | None = None,
    robot: RobotArg = None,
) -> int:
    """Draw a world, or a sheet of several, as a PNG file.

    Args:
        source: kind of generated worlds (clutter:12, barn:0-11, ...), a file, or a folder.
        out: the picture.
        columns: worlds side by side.
        size: side of each [pixels].
        difficulty: of generated worlds, 0 to 1.
        robot: preset or config file; generated worlds fit its footprint.
    """
    from acsar_gym.evaluation import atlas  # noqa: PLC0415

    most = atlas.most_drawn(columns, size, out)
    atlas.draw(atlas.raw(source, difficulty, robot, 12, most), columns, size, out)
    print(printable(f"drawn: {out}"))
    return 0


def check(
    source: Source, difficulty: float | None = None, robot: RobotArg = None, json: Json = None
) -> int:
    """Say whether the robot can cross worlds, how far it is, and how hard by BARN's measures.

    Args:
        source: kind of generated worlds (clutter:12, barn:0-11, ...), a file, or a folder.
        difficulty: of generated worlds, 0 to 1.
        robot: preset or config file, for its footprint.
        json: write the findings here too.
    """
    from acsar_gym.evaluation import atlas, report  # noqa: PLC0415

    report.check_writable(json)
    findings = atlas.check(atlas.raw(source, difficulty, robot, 12), robot)
    told = atlas.told(source, 12)
    report.show(atlas.table(str(told["source"]), findings))
    report.write_json(json, told | {"worlds": [finding.as_dict() for finding in findings]})
    return int(any(finding.fault for finding in findings))


def convert(
    source: Source, out: OutFile, difficulty: float | None = None, robot: RobotArg = None
) -> int:
    """Write a world to the project's own .json or .yaml.

    Args:
        source: a .world file, a ROS map's YAML, or a generated one like barn:7-7.
        out: .json or .yaml file.
        difficulty: of generated worlds, 0 to 1.
        robot: preset or config file; generated worlds fit its footprint.
    """
    from acsar_gym.evaluation import atlas  # noqa: PLC0415

    atlas.convert(source, out, difficulty, robot)
    print(printable(f"written: {out}"))
    return 0


def warm_up(robot: RobotArg = None) -> int:
    """Compile all loops and make the default worlds now, instead of when they are first used.

    Args:
        robot: preset or config file; generated worlds fit its footprint.
    """
    from acsar_gym.envs import warm_up as warm  # noqa: PLC0415

    found = []
    for name in warm.BATCHES:
        print(f"{name}: ", end="", flush=True)
        found.append(done := warm.run(name, robot))
        worlds = f", {done.worlds} worlds at hand" if done.worlds else ""
        print(f"{done.functions} functions compiled{worlds}, {done.seconds:.1f} s", flush=True)
    total, seconds = sum(done.functions for done in found), sum(done.seconds for done in found)
    print(f"ready in {seconds:.1f} s" + ("" if total else ": everything had been compiled before"))
    return 0


WORLDS: dict[str, Callable[..., Any]] = {"show": show, "check": check, "convert": convert}


def worlds() -> int:
    """Draw, check or convert worlds: acsar-gym worlds show|check|convert SOURCE."""
    return int(
        tyro.extras.subcommand_cli_from_dict(WORLDS, prog="acsar-gym worlds", args=sys.argv[2:])
    )


def estop() -> int:
    """Stop every real robot that you are driving from this computer, whatever drives it."""
    from acsar_gym.safety import estop as stops  # noqa: PLC0415

    return stops.command()


COMMANDS: dict[str, Callable[..., Any]] = {
    "demo": demo,
    "bench": bench,
    "emulate": emulate,
    "doctor": doctor,
    "drive": drive,
    "estop": estop,
    "train": train,
    "evaluate": evaluate,
    "run": run,
    "export": export,
    "worlds": worlds,
    "warm-up": warm_up,
}


def _one_line(
    message: Warning | str,
    category: type[Warning],
    filename: str,
    lineno: int,
    line: str | None = None,
) -> str:
    """A warning of this package for the terminal; others as Python shows them."""
    if issubclass(category, SafetyWarning):
        return f"acsar-gym: {printable(str(message))}\n"
    return FORMAT(message, category, filename, lineno, line)


def main() -> None:
    """Entry point: errors of this package become one line and an exit code."""
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):  # what a terminal can't show is no error
            stream.reconfigure(errors="backslashreplace")
    warnings.formatwarning = _one_line
    try:
        if sys.argv[1:] == ["--version"]:
            print(f"acsar-gym {acsar_gym.__version__}")
            code = 0
        elif sys.argv[1:2] == ["train"]:
            code = train()
        elif sys.argv[1:2] == ["worlds"]:
            code = worlds()
        else:
            code = tyro.extras.subcommand_cli_from_dict(COMMANDS, prog="acsar-gym")
    except AcsarError as error:
        print(f"acsar-gym: {printable(str(error))}", file=sys.stderr)
        code = error.exit_code
    except KeyboardInterrupt:
        driving = sys.argv[1:2] in (["drive"], ["run"], ["evaluate"], ["doctor"])
        stopped = ", the wheels were commanded to stop" if driving else ""
        print(f"\nacsar-gym: interrupted{stopped}", file=sys.stderr)
        code = 130
    sys.exit(code)
