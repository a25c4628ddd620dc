"""The camera's pictures, and that nothing waits for them."""

from __future__ import annotations

import os
import signal
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from io import BytesIO
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("pybullet")

from PIL import Image

from acsar_gym.errors import RenderError
from acsar_gym.physics.bullet import BulletBody
from acsar_gym.render.canvas import encode_png
from acsar_gym.tools.view import camera
from acsar_gym.tools.view.app import make_app
from acsar_gym.tools.view.camera import PICTURE_SIZE
from acsar_gym.tools.view.session import Session
from acsar_gym.worlds import Scene

pytestmark = pytest.mark.usefixtures("deadline")
BASE = "http://127.0.0.1:8050"


@pytest.fixture(scope="module")
def session(tape: Path) -> Iterator[Session]:
    made = Session(tape)
    yield made
    made.close()


def test_a_picture_is_encoded_as_others_decode_it() -> None:
    image = np.random.default_rng(1).integers(0, 256, (30, 50, 3), np.uint8)
    assert (np.asarray(Image.open(BytesIO(encode_png(image)))) == image).all()


def test_the_camera_sees_the_robot_where_it_was(session: Session) -> None:
    truth, pictures = session.tail.episodes[0].truth.rows, []
    for row in (0, 100):
        drawn = np.asarray(Image.open(BytesIO(session.draw_picture(0, 0, row))))
        body = BulletBody(session.tail.config)
        x, y, theta = truth[row, 1:4].tolist()
        body.reset(Scene((x, y, theta)))
        assert (drawn == body.image(*PICTURE_SIZE)).all()
        body.close()
        pictures.append(drawn)
    assert (pictures[0] != pictures[1]).any()


def test_the_page_names_the_picture_of_the_shown_time(session: Session) -> None:
    _, texts = session.draw(0, 0.505)
    run, episode, row = map(int, texts["camera"].split("/"))
    truth = session.tail.episodes[0].truth.rows
    assert (run, episode) == (0, 0)
    assert truth[row, 0] <= 0.505 < truth[row + 1, 0]


def test_pictures_are_kept_and_a_process_that_has_ended_is_started_again(
    session: Session,
) -> None:
    before = session.draw_picture(0, 0, 0)
    session._camera._process.kill()
    assert session.draw_picture(0, 0, 0) is before
    with pytest.raises(RenderError, match="has ended, or hangs"):
        session.draw_picture(0, 0, 50)
    assert session.draw_picture(0, 0, 50)


def test_a_process_that_hangs_is_replaced(
    session: Session, monkeypatch: pytest.MonkeyPatch
) -> None:
    session.draw_picture(0, 0, 60)
    with monkeypatch.context() as patch:
        patch.setattr(camera, "PICTURE_TIMEOUT", 0.1)
        os.kill(session._camera._process.pid, signal.SIGSTOP)
        with pytest.raises(RenderError, match="hangs"):
            session.draw_picture(0, 0, 70)
    assert session.draw_picture(0, 0, 70)


def test_what_cannot_be_drawn_is_a_line(tape: Path) -> None:
    real = Session(tape)
    with pytest.raises(RenderError, match="another recording"):
        real.draw_picture(1, 0, 0)
    with pytest.raises(RenderError, match="true pose"):
        real.draw_picture(0, 0, 10**9)
    real.tail.episodes[0].truth.rows[:, 1:] = np.nan
    client = make_app(real).server.test_client()
    answer = client.get("/camera/0/0/0", base_url=BASE)
    assert (answer.status_code, answer.mimetype) == (200, "text/plain")
    assert answer.get_data(as_text=True) == "no picture: only simulated robots have this camera"
    assert real._camera._process is None


def test_without_pybullet_the_extra_is_named(
    tape: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "pybullet.py").write_text("raise ImportError")
    monkeypatch.syspath_prepend(tmp_path)
    bare = Session(tape)
    with pytest.raises(RenderError, match=r"acsar_gym\[bullet\]"):
        bare.draw_picture(0, 0, 0)
    bare.close()


def test_the_stop_does_not_wait_for_a_picture(session: Session) -> None:
    app = make_app(session)
    page = app.server.test_client().get("/", base_url=BASE).get_data(as_text=True)
    mark = page.split('name="stop-token" content="')[1].split('"')[0]
    session.draw_picture(0, 0, 80)
    process = session._camera._process.pid
    with ThreadPoolExecutor(1) as other:
        os.kill(process, signal.SIGSTOP)
        try:
            client = app.server.test_client()
            picture = other.submit(client.get, "/camera/0/0/90", base_url=BASE)
            while not session._camera._drawing.locked():
                assert not picture.done()
            headers = {"stop-token": mark}
            answer = app.server.test_client().post("/stop", base_url=BASE, headers=headers)
            assert answer.get_data(as_text=True).startswith("nothing to stop")
            assert session.poll() == 1
            assert not picture.done()
        finally:
            os.kill(process, signal.SIGCONT)
        assert picture.result().mimetype == "image/png"
