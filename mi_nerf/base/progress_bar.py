"""Progress bars: on terminals and in notebooks, nowhere else."""

from __future__ import annotations

import sys
import warnings
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from tqdm import tqdm


def bars_are_seen() -> bool:
    """Whether a bar that redraws itself is of use: on a terminal or in a notebook."""
    return sys.stderr.isatty() or in_notebook()


def in_notebook() -> bool:
    """Whether a Jupyter kernel runs this code."""
    shell = getattr(sys.modules.get("IPython"), "get_ipython", lambda: None)()
    return hasattr(shell, "kernel")


def progress_bar(
    name: str, unit: str, total: float | None = None, *, show: bool = True, **options: Any
) -> tqdm[Any]:
    """A bar where bars are seen; otherwise one that draws nothing."""
    hidden = not (show and bars_are_seen())
    return _kind_of_bar()(desc=name, unit=unit, total=total, disable=hidden, **options)


def _kind_of_bar() -> Any:
    """The bars of terminals, or of notebooks, which take longer to import."""
    if not in_notebook():
        import tqdm

        return tqdm.tqdm
    with warnings.catch_warnings():
        # Without ipywidgets, a notebook gets bars of text, which is no reason to warn.
        warnings.filterwarnings("ignore", message="IProgress not found")
        from tqdm.auto import tqdm as either

        return either
