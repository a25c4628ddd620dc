"""The live view: a server on loopback, to which a viewer connects."""

from __future__ import annotations

import json
import struct
from pathlib import Path

from websockets.sync.client import connect

from acsar_gym import Robot, RobotConfig, open_link
from acsar_gym.recording import Recorder
from acsar_gym.recording.sinks import LiveView

CONFIG = RobotConfig.of(None)
PROTOCOLS = ["foxglove.sdk.v1", "foxglove.websocket.v1"]


def test_a_viewer_gets_topics_and_messages(tmp_path: Path) -> None:
    view = LiveView(port=0)
    assert view.url.startswith("ws://127.0.0.1:")
    recorder = Recorder(tmp_path / "tape.mcap", sinks=[view])
    with connect(view.url, subprotocols=PROTOCOLS, open_timeout=10, close_timeout=0.2) as viewer:  # type: ignore[arg-type]
        offered: dict[str, dict[str, object]] = {}
        while "/odom" not in offered:
            told = json.loads(viewer.recv(timeout=10))
            for channel in told.get("channels", ()):
                offered[channel["topic"]] = channel
        assert offered["/odom"]["schemaName"] == "nav_msgs/msg/Odometry"
        assert offered["/odom"]["encoding"] == "cdr"
        wanted = [
            {"id": number, "channelId": offered[topic]["id"]}
            for number, topic in enumerate(("/odom", "/tf_static"))
        ]
        viewer.send(json.dumps({"op": "subscribe", "subscriptions": wanted}))
        heard: set[int] = set()
        with Robot(open_link("planar", CONFIG, realtime=True), CONFIG, recorder=recorder) as robot:
            for _ in range(100):
                robot.drive(0.1, 0.0)
            while len(heard) < 2:
                data = viewer.recv(timeout=10)
                if isinstance(data, bytes) and data[0] == 1:
                    heard.add(struct.unpack_from("<I", data, 1)[0])
    assert heard == {0, 1}


def test_a_taken_port_is_no_obstacle() -> None:
    first = LiveView(port=0)
    second = LiveView(port=int(first.url.rsplit(":", 1)[1]))
    assert first.url != second.url
    for view in (first, second):
        view.close(0)
