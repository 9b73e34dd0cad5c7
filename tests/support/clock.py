"""A clock for tests of what counts as training time."""

from __future__ import annotations


class Clock:
    """Stands in for ``time.monotonic``: about a millisecond passes whenever somebody looks."""

    def __init__(self) -> None:
        self.now = 1000.0

    def __call__(self) -> float:
        self.now += 2.0**-10  # exact, so that what is added up stays so
        return self.now
