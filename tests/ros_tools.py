"""Nodes in processes of their own, and a node of the tests that watches and commands them."""

from __future__ import annotations

import contextlib
import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import rclpy
from rcl_interfaces.srv import SetParameters
from rclpy.executors import SingleThreadedExecutor
from rclpy.parameter import Parameter
from rclpy.qos import QoSProfile, ReliabilityPolicy
from std_srvs.srv import Trigger

from acsar_gym.testing import TIMEOUT

FOREIGN_ROBOT = Path(__file__).parent / "ros" / "foreign_robot.py"
BEST_EFFORT = QoSProfile(depth=100, reliability=ReliabilityPolicy.BEST_EFFORT)


class Program:
    """A process with a node: `python FILE ...` or `python -m acsar_gym ...`.

    Attributes:
        process: with a session of its own, so that a signal can go to all of its processes.
        output: file of what it printed, errors included.
        signalled: whether it got a signal, so that it may end.
    """

    def __init__(self, arguments: tuple[str, ...], folder: Path) -> None:
        self.arguments = arguments
        self.signalled = False
        self.output = folder / f"program{len(list(folder.glob('program*.txt')))}.txt"
        with self.output.open("wb") as output:
            self.process = subprocess.Popen(
                [sys.executable, *arguments],
                stdin=subprocess.DEVNULL,
                stdout=output,
                stderr=subprocess.STDOUT,
                start_new_session=True,
                env=os.environ | {"PYTHONUNBUFFERED": "1", "NO_COLOR": "1", "TERM": "dumb"},
            )

    @property
    def printed(self) -> str:
        """What it has printed so far."""
        return self.output.read_text(errors="replace")

    def send(self, number: int) -> None:
        """Send a signal to the process alone."""
        self.signalled = True
        self.process.send_signal(number)

    def end(self, number: int = signal.SIGTERM) -> int:
        """End it by a signal, and return its exit status."""
        self.send(number)
        return self.wait()

    def wait(self) -> int:
        """Wait until it ends by itself, and return its exit status."""
        return self.process.wait(TIMEOUT)

    def kill(self) -> None:
        """Kill it with all that it started."""
        self.signalled = True
        with contextlib.suppress(ProcessLookupError):
            os.killpg(self.process.pid, signal.SIGKILL)
        self.process.wait(TIMEOUT)


class ForeignRobot(Program):
    """foreign_robot.py, and its log."""

    def __init__(self, folder: Path, **options: Any) -> None:
        self.log = folder / f"robot{len(list(folder.glob('robot*.jsonl')))}.jsonl"
        super().__init__((str(FOREIGN_ROBOT), str(self.log), json.dumps(options)), folder)

    def _lines(self, key: str) -> list[dict[str, Any]]:
        lines = self.log.read_text().splitlines() if self.log.exists() else []
        events = [json.loads(line) for line in lines if line.endswith("}")]
        return [event for event in events if key in event]

    @property
    def commands(self) -> list[dict[str, Any]]:
        """Commands that it received, those that it refused included."""
        return self._lines("command")

    @property
    def states(self) -> list[dict[str, Any]]:
        """True speeds [rad/s] of its wheels and its true pose, at its rate."""
        return self._lines("speeds")

    def stands(self, slowest: float = 0.05) -> bool:
        """Whether its wheels stand still now."""
        return all(abs(speed) < slowest for speed in self.states[-1]["speeds"])


StartProgram = Callable[..., Program]
StartRobot = Callable[..., ForeignRobot]


@dataclass
class Heard:
    """Messages of a topic, and when each arrived, in monotonic time [s]."""

    messages: list[Any] = field(default_factory=list)
    times: list[float] = field(default_factory=list)

    def append(self, message: Any) -> None:
        self.messages.append(message)
        self.times.append(time.monotonic())


class Client:
    """A node of the tests. It hears while one of its methods runs.

    Args:
        namespace: of the node, so that relative names are those of the robot.
        programs: whose ends and output a failing wait tells.
    """

    def __init__(self, namespace: str, programs: list[Program]) -> None:
        self.programs = programs
        self.context = rclpy.Context()
        self.context.init()
        self.node = rclpy.create_node("client", namespace=namespace, context=self.context)
        self.executor = SingleThreadedExecutor(context=self.context)
        self.executor.add_node(self.node)

    def close(self) -> None:
        """Leave the graph."""
        self.executor.shutdown()
        self.node.destroy_node()
        self.context.try_shutdown()

    def hear(self, kind: type, topic: str, qos: QoSProfile = BEST_EFFORT) -> Heard:
        """Subscribe, and keep all messages."""
        heard = Heard()
        self.node.create_subscription(kind, topic, heard.append, qos)
        return heard

    def publisher(self, kind: type, topic: str, qos: QoSProfile | int = 10) -> Any:
        """A publisher that a subscription has found already."""
        publisher = self.node.create_publisher(kind, topic, qos)
        self.wait(lambda: publisher.get_subscription_count() > 0, f"a subscription of {topic}")
        return publisher

    def call(self, kind: Any, service: str, request: Any = None) -> Any:
        """The answer of a service."""
        client = self.node.create_client(kind, service)
        self.wait(client.service_is_ready, f"the service {service}")
        future = client.call_async(request or kind.Request())
        self.wait(future.done, f"an answer of {service}")
        return future.result()

    def set_scene(self, name: str, start: Sequence[float] = ()) -> Any:
        """Set the scene of a driver with a simulated robot, and reset it. Returns the answer."""
        values = {"scene": name} | ({"start": list(start)} if start else {})
        request = SetParameters.Request(
            parameters=[
                Parameter(key, value=value).to_parameter_msg() for key, value in values.items()
            ]
        )
        self.call(SetParameters, "acsar_driver/set_parameters", request)
        return self.call(Trigger, "acsar_driver/reset")

    def spin(self, seconds: float) -> None:
        """Hear for a time."""
        end = time.monotonic() + seconds
        while (remaining := end - time.monotonic()) > 0.0:
            self.executor.spin_once(timeout_sec=remaining)

    def wait(self, condition: Callable[[], bool], what: str, timeout: float = TIMEOUT) -> None:
        """Hear until a condition holds.

        Raises:
            AssertionError: it doesn't within this time, or a program ended by itself before.
        """
        deadline = time.monotonic() + timeout
        alive = [program for program in self.programs if program.process.poll() is None]
        while not condition():
            ended = [
                program
                for program in alive
                if program.process.poll() is not None and not program.signalled
            ]
            if not (ended or time.monotonic() > deadline):
                self.executor.spin_once(timeout_sec=0.01)
            elif not condition():
                outputs = "\n".join(program.printed for program in ended or self.programs)
                why = "a program ended" if ended else f"not within {timeout:g} s"
                raise AssertionError(f"{what}: {why}\n{outputs}")
