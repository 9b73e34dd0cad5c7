"""Mitsuba XML scenes: parsed, adjusted, loaded, with errors of one line."""

from __future__ import annotations

import hashlib
import re
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from xml.sax.saxutils import quoteattr

import numpy as np

from ..base.errors import InputError
from .instancing import copy_instances

_ASKED = "mi_nerf_asked"  # the id of a shape in a scene that is parsed, never loaded

Bounds = tuple[tuple[float, float, float], tuple[float, float, float]]


class SceneFile:
    """A parsed scene that is not loaded yet. A Mitsuba variant must be set.

    Raises:
        InputError: if the file is missing, or Mitsuba cannot parse it.
    """

    def __init__(self, path: str | Path, parameters: Mapping[str, str] | None = None) -> None:
        """Parses ``path`` with values for its ``$parameters``."""
        import mitsuba as mi

        self.path = Path(path)
        self.parameters = dict(parameters or {})
        if not self.path.is_file():
            raise InputError(f"{path}: not found, expected a Mitsuba XML scene")
        self._config = mi.parser.ParserConfig(mi.variant())
        with self._one_line_errors(), self._beside_the_file():
            self._state = mi.parser.parse_file(self._config, str(self.path), **self.parameters)
        if self._state.root.type != mi.ObjectType.Scene:
            raise InputError(f"{path}: expected <scene> as the outermost element")

    def default(self, name: str) -> str | None:
        """The value of a ``$parameter``: as given, or by the file's own ``<default>``."""
        import mitsuba as mi

        if name in self.parameters:
            return self.parameters[name]
        # Mitsuba's parser takes much that is no XML, and does not tell defaults: it is asked what
        # it puts for the parameter in a scene that includes the file. The first default counts.
        asking = (
            f'<scene version="3.0.0"><include filename={quoteattr(self.path.name)}/>'
            f'<default name="{name}" value=""/>'
            f'<shape type="cube" id="{_ASKED}"><string name="value" value="${name}"/></shape>'
            "</scene>"
        )
        with self._one_line_errors(), self._beside_the_file():
            state = mi.parser.parse_string(self._config, asking, **self.parameters)
        shape = state.nodes[state.id_to_index[_ASKED]].props
        return str(shape["value"]) or None

    def plugins(self, kind: str) -> list[Any]:
        """The properties of all plugins of a kind, such as ``"Sensor"``."""
        import mitsuba as mi

        wanted = getattr(mi.ObjectType, kind)
        return [node.props for node in self._state.nodes if node.type == wanted]

    def load(self) -> Any:
        """Creates the scene.

        Raises:
            InputError: with what Mitsuba says, if it refuses.
        """
        import mitsuba as mi

        with self._one_line_errors(), self._beside_the_file():
            mi.parser.transform_resolve(self._config, self._state)
            copy_instances(self._state)
            mi.parser.transform_all(self._config, self._state)
            scene = mi.parser.instantiate(self._config, self._state)
        return scene[0] if isinstance(scene, list) else scene

    def digest(self) -> str:
        """SHA-256 of the scene: its XML, parameters, and the files that it names."""
        import mitsuba as mi

        total = hashlib.sha256()
        for name, value in sorted(self.parameters.items()):
            total.update(f"{name}={value}\n".encode())
        files = [Path(str(file)) for file in self._state.files]
        with self._beside_the_file():
            for node in self._state.nodes:
                if "filename" in node.props:
                    files.append(Path(str(mi.file_resolver().resolve(node.props["filename"]))))
        for file in files:
            try:
                total.update(hashlib.sha256(file.read_bytes()).digest())
            except OSError as error:
                raise InputError(
                    f"{self.path}: {file}: cannot be read: {error.strerror}"
                ) from error
        return total.hexdigest()

    @contextmanager
    def _one_line_errors(self) -> Iterator[None]:
        """Says in one line what Mitsuba refuses; a fault of a Python plugin comes as it is."""
        try:
            yield
        except RuntimeError as error:  # for all that can be wrong, what plugins raise included
            message = _refusal(str(error))
            if message is None:
                raise
            raise InputError(f"{self.path}: Mitsuba cannot load this scene: {message}") from error

    @contextmanager
    def _beside_the_file(self) -> Iterator[None]:
        """Relative names in the scene are looked up beside it first."""
        import mitsuba as mi

        resolver = mi.file_resolver()
        before = [str(folder) for folder in resolver]
        resolver.prepend(str(self.path.resolve().parent))
        try:
            yield
        finally:
            resolver.clear()
            for folder in before:
                resolver.append(folder)


def visible_bounds(scene: Any, kept: Callable[[Any], bool] = lambda shape: False) -> Bounds | None:
    """The corners of the box around all shapes that are seen; None without any.

    Args:
        kept: Whether a shape that is a light source is seen.
    """
    corners = []
    for shape in scene.shapes():
        box = shape.bbox()
        if (
            not shape.is_emitter() or kept(shape)
        ) and box.valid():  # what was merged into another has none
            corners.append([np.ravel(box.min), np.ravel(box.max)])
    if not corners:
        return None
    both = np.array(corners, np.float64)
    lower, upper = both[:, 0].min(axis=0), both[:, 1].max(axis=0)
    if not np.isfinite(both).all():
        return None
    return tuple(lower.tolist()), tuple(upper.tolist())


def _refusal(message: str) -> str | None:
    """What Mitsuba says, in one line; None if a Python plugin failed by a fault of its own.

    An exception of a plugin comes as the text of its traceback. Plugins of mi_nerf refuse by
    InputError, those of Mitsuba and others by a plain Exception.
    """
    before, found, traceback = message.partition("Traceback (most recent call last):")
    if found:
        said = re.search(r"^(?:[\w.]+\.)?(\w+): (.*)", traceback, re.MULTILINE | re.DOTALL)
        if said is None or said[1] not in ("InputError", "Exception", "RuntimeError"):
            return None
        message = before + said[2]
    return " ".join(message.split())
