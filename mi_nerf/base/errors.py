"""The one exception for input that the user can put right."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple


class Option(NamedTuple):
    """An argument that an error names: ``size=(0, 5)``, or without a value ``size``."""

    name: str
    value: Any = None

    def __str__(self) -> str:
        return self.name if self.value is None else f"{self.name}={self.value!r}"


class InputError(ValueError):
    """The user's input is at fault.

    The message is one line that names the file or the value and says what was
    expected. The command line prints it, with options in its own words, and exits
    with status 2; a fault of the program itself must never be raised as this type.
    """

    def __init__(self, message: str, *values: object) -> None:
        """With ``values``, a template for them as of ``str.format``; :class:`Option` may be one."""
        super().__init__(message, *values)

    def __str__(self) -> str:
        return self.told(str)

    def told(self, words: Callable[[Option], str]) -> str:
        """The message, with options as ``words`` writes them."""
        message, *values = self.args
        told = (words(v) if isinstance(v, Option) else v for v in values)
        return str(message.format(*told) if values else message)
