"""Signals during a training."""

from __future__ import annotations

import signal
from collections.abc import Iterator

import pytest

from acsar_gym.tools.training.checkpoints import STOP_SIGNALS, StopRequest

NUMBERS = pytest.mark.parametrize("number", STOP_SIGNALS, ids=lambda number: number.name)


@pytest.fixture(autouse=True)
def _default_handlers() -> Iterator[None]:
    """However the tests were started."""
    before = {
        signal.SIGINT: signal.signal(signal.SIGINT, signal.default_int_handler),
        signal.SIGTERM: signal.signal(signal.SIGTERM, signal.SIG_DFL),
    }
    yield
    for number, handler in before.items():
        signal.signal(number, handler)


@NUMBERS
def test_the_first_signal_is_noted(number: signal.Signals) -> None:
    with StopRequest() as stop:
        stop.defer()
        assert stop.exit_code == 0
        signal.raise_signal(number)
        assert stop.number == number
        assert stop.exit_code == 128 + number


@NUMBERS
def test_without_anything_to_save_the_program_ends_at_once(number: signal.Signals) -> None:
    ending = KeyboardInterrupt if number == signal.SIGINT else SystemExit
    with StopRequest() as stop, pytest.raises(ending) as ended:
        signal.raise_signal(number)
    assert stop.exit_code == 128 + number
    assert ended.value.args in ((), (stop.exit_code,))


def test_handlers_are_put_back_and_ignored_signals_stay_ignored() -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    with StopRequest():
        assert signal.getsignal(signal.SIGINT) is signal.SIG_IGN
        assert signal.getsignal(signal.SIGTERM) is not signal.SIG_DFL
    assert signal.getsignal(signal.SIGTERM) is signal.SIG_DFL
