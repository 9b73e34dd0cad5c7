"""Ctrl-C as a request that long work honours between two of its steps."""

from __future__ import annotations

import signal
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import Any


class Interrupts(list[int]):
    """Numbers of the signals that have come in; after the first, they act as usual again."""

    def __init__(self) -> None:
        super().__init__()
        self._previous: dict[int, Any] = {}

    @contextmanager
    def released(self) -> Iterator[None]:
        """Inside, signals act as they would without :func:`interruptible`."""
        self._give_back()
        try:
            yield
        finally:
            if not self:
                self._take()

    def _take(self) -> None:
        with suppress(ValueError):  # not the main thread: signals go where they always go
            for number in (signal.SIGINT, signal.SIGTERM):
                previous = signal.getsignal(number)
                if previous is not None:  # set from C: it could not be put back
                    signal.signal(number, self._handle)
                    self._previous[number] = previous

    def _give_back(self) -> None:
        with suppress(ValueError):
            while self._previous:
                signal.signal(*self._previous.popitem())

    def _handle(self, number: int, _frame: Any) -> None:
        self.append(number)
        self._give_back()


@contextmanager
def interruptible() -> Iterator[Interrupts]:
    """Collects SIGINT and SIGTERM instead of raising; a second one acts as usual."""
    received = Interrupts()
    received._take()
    try:
        yield received
    finally:
        received._give_back()
