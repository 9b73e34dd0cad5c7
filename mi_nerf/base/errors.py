"""The one exception for input that the user can put right."""

from __future__ import annotations


class InputError(ValueError):
    """The user's input is at fault.

    The message is one line that names the file or the value and says what was
    expected. The command line prints it as it stands and exits with status 2; a
    fault of the program itself must never be raised as this type.
    """
