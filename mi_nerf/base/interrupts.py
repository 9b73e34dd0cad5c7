"""Ctrl-C as a request that long work honours between two of its steps."""

from __future__ import annotations

import signal
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any


@contextmanager
def interruptible() -> Iterator[list[int]]:
    """Collects SIGINT and SIGTERM instead of raising; a second one acts as usual."""
    received: list[int] = []
    previous: dict[int, Any] = {}

    def handler(number: int, _frame: Any) -> None:
        received.append(number)
        signal.signal(number, previous[number])

    try:
        for number in (signal.SIGINT, signal.SIGTERM):
            previous[number] = signal.getsignal(number)
            signal.signal(number, handler)
    except ValueError:  # not the main thread: signals go where they always go
        previous.clear()
    try:
        yield received
    finally:
        for restored, action in previous.items():
            signal.signal(restored, action)
