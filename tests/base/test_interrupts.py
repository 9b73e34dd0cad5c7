"""Signals as requests: who has them when, and that they are given back."""

from __future__ import annotations

import signal
from typing import Any

import pytest

from mi_nerf.base.interrupts import interruptible


@pytest.fixture
def handlers() -> Any:
    """The handlers of both signals; as they are, whatever the test does to them."""
    numbers = (signal.SIGINT, signal.SIGTERM)
    before = [signal.getsignal(n) for n in numbers]
    yield lambda: [signal.getsignal(n) for n in numbers]
    for number, handler in zip(numbers, before, strict=True):
        signal.signal(number, handler)


def test_the_first_signal_is_a_request_and_the_second_acts(handlers: Any) -> None:
    before = handlers()
    with pytest.raises(KeyboardInterrupt), interruptible() as received:
        signal.raise_signal(signal.SIGINT)
        assert received == [signal.SIGINT]
        signal.raise_signal(signal.SIGINT)
    assert handlers() == before


def test_released_signals_act_as_usual(handlers: Any) -> None:
    before = handlers()
    with interruptible() as received:
        taken = handlers()
        with received.released():
            assert handlers() == before
            with pytest.raises(KeyboardInterrupt):
                signal.raise_signal(signal.SIGINT)
        assert handlers() == taken != before
        assert not received
    assert handlers() == before


def test_a_handler_that_python_does_not_know_is_left_alone(
    handlers: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    """``getsignal`` says ``None`` of one that a program around Python has set from C."""
    known = signal.getsignal
    theirs = signal.signal(signal.SIGTERM, lambda *_: None)  # stands for that one
    monkeypatch.setattr(signal, "getsignal", lambda n: None if n == signal.SIGTERM else known(n))
    there = known(signal.SIGTERM)
    with interruptible() as received:
        assert known(signal.SIGTERM) is there
        signal.raise_signal(signal.SIGINT)
    assert received == [signal.SIGINT] and known(signal.SIGTERM) is there
    signal.signal(signal.SIGTERM, theirs)
