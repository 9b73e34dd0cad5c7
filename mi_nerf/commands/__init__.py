"""The sub-commands of ``mi-nerf``, one a module: their options, and what they call."""

from __future__ import annotations

import importlib
import inspect
from collections.abc import Iterator, Mapping
from typing import Annotated, Any, Union

from tyro.conf import subcommand


class _Commands(Mapping[str, Any]):
    """The commands by name; a module is imported when its command is first asked for.

    Training, say, would otherwise wait for the imports of reports and generators.
    """

    _places = {
        "demo": ("demo", "Demo"),
        "generate": ("generate", "Generate"),
        "train": ("train", "Train"),
        "ablate": ("ablate", "Ablate"),
        "eval": ("evaluate", "Eval"),
        "render": ("render", "Render"),
        "report": ("report", "Report"),
        "import": ("importing", "Import"),
        "info": ("info", "Info"),
    }

    def __getitem__(self, name: str) -> Any:
        module, command = self._places[name]
        return getattr(importlib.import_module(f".{module}", __name__), command)

    def __contains__(self, name: object) -> bool:
        return name in self._places  # Mapping's own would import it

    def __iter__(self) -> Iterator[str]:
        return iter(self._places)

    def __len__(self) -> int:
        return len(self._places)


COMMANDS = _Commands()


def examples(name: str) -> str:
    """What the help of a command says first: its purpose, and examples."""
    return inspect.getdoc(COMMANDS[name]) or ""


def all_commands() -> Any:
    """All sub-commands as one type for tyro, without their examples."""
    options = []
    for name, command in COMMANDS.items():
        text = examples(name).splitlines()[0]
        options.append(Annotated[command, subcommand(name, description=text)])
    return Union[tuple(options)]  # noqa: UP007
