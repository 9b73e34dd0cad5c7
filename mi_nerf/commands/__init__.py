"""The sub-commands of ``mi-nerf``, one a module: their options, and what they call."""

from __future__ import annotations

import inspect
from typing import Annotated, Any, Union

from tyro.conf import subcommand

from .ablate import Ablate
from .demo import Demo
from .evaluate import Eval
from .generate import Generate
from .importing import Import
from .info import Info
from .render import Render
from .report import Report
from .train import Train

COMMANDS = {
    "demo": Demo,
    "generate": Generate,
    "train": Train,
    "ablate": Ablate,
    "eval": Eval,
    "render": Render,
    "report": Report,
    "import": Import,
    "info": Info,
}


def command_type(chosen: str | None) -> Any:
    """All sub-commands as one type for tyro; only the chosen one shows its examples."""
    options = []
    for name, command in COMMANDS.items():
        text = inspect.getdoc(command) or ""
        shown = text if name == chosen else text.splitlines()[0]
        options.append(Annotated[command, subcommand(name, description=shown)])
    return Union[tuple(options)]  # noqa: UP007
