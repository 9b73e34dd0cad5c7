"""A file in the folder of the results: while it is there, jobs may work.

It tells two things across machines with nothing but the file system that all of them share. A
worker that does not see it does not share the folder. And a job that takes hours looks now and
then whether it is still there, to stop and save what it has when it is gone.
"""

from __future__ import annotations

import platform
import secrets
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from ..base.errors import InputError
from ..base.files import make_folder

_PREFIX = ".working-"
_PATIENCE = 5.0  # seconds that a network's file system may take to show a new file
_SECONDS_BETWEEN_LOOKS = 1.0
_SEEN: set[Path] = set()  # by this process: no need to wait for them


class NotPermittedError(InputError):
    """The file is not there: not any more, or the folder is another one."""


@dataclass(frozen=True)
class Permit:
    """As jobs get it with their arguments."""

    path: Path  # absolute

    def require(self, patience: float = _PATIENCE) -> None:
        """To be called first of all where a job runs.

        Raises:
            NotPermittedError: if the file is not there.
        """
        end = time.monotonic() + (0 if self.path in _SEEN else patience)
        while not self.path.exists():
            if time.monotonic() > end or self._others():
                raise NotPermittedError(
                    f"{self.path.parent}: the worker on {platform.node()} does not see what is "
                    "there, expected a folder that all workers share under this name"
                )
            time.sleep(0.05)
        _SEEN.add(self.path)

    def _others(self) -> bool:
        """Whether the folder has been seen as it is, with the files of the work in it."""
        return any(self.path.parent.glob(f"{_PREFIX}*"))

    def withdraw(self) -> None:
        """Asks jobs to stop."""
        self.path.unlink(missing_ok=True)

    def watched(self) -> Watch:
        """A way to ask often whether the file is still there."""
        return Watch(self.path)


class Watch:
    """Tells whether work may go on; looks at the file once a second at most."""

    def __init__(self, path: Path) -> None:
        self._path, self._looked, self._there = path, time.monotonic(), True

    def __call__(self) -> bool:
        now = time.monotonic()
        if self._there and now - self._looked > _SECONDS_BETWEEN_LOOKS:
            self._looked, self._there = now, self._path.exists()
        return self._there


@contextmanager
def permitted(folder: str | Path) -> Iterator[Permit]:
    """A permit to work in a folder, which is made if need be; earlier ones end.

    Raises:
        InputError: if the folder cannot be written to.
    """
    place = make_folder(folder).absolute()
    for old in place.glob(f"{_PREFIX}*"):  # of a process that was killed
        old.unlink(missing_ok=True)
    permit = Permit(place / f"{_PREFIX}{secrets.token_hex(8)}")
    try:
        permit.path.touch(exist_ok=False)
    except OSError as error:
        raise InputError(f"{folder}: cannot be written: {error.strerror}") from error
    try:
        yield permit
    finally:
        permit.withdraw()
