"""Mitsuba XML scenes: parsed, adjusted, loaded, with errors of one line."""

from __future__ import annotations

import hashlib
import re
import xml.etree.ElementTree as ElementTree
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from ..base.errors import InputError
from .instancing import copy_instances

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
        with self._one_line_errors():
            self._state = mi.parser.parse_file(self._config, str(self.path), **self.parameters)
        if self._state.root.type != mi.ObjectType.Scene:
            raise InputError(f"{path}: expected <scene> as the outermost element")

    def default(self, name: str) -> str | None:
        """The value of a ``$parameter``: as given, or by the file's own ``<default>``."""
        if name in self.parameters:
            return self.parameters[name]
        for element in ElementTree.parse(self.path).getroot().iter("default"):
            if element.get("name") == name:
                return element.get("value")
        return None

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
        """Says in one line what Mitsuba refuses."""
        try:
            yield
        except InputError:
            raise
        except Exception as error:  # Mitsuba raises RuntimeError for all that can be wrong
            message = _without_traceback(str(error))
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


def load_scene(path: str | Path) -> Any:
    """Loads Mitsuba XML as it is.

    Raises:
        InputError: if the file is missing or Mitsuba refuses it.
    """
    return SceneFile(path).load()


def visible_bounds(scene: Any) -> Bounds | None:
    """The corners of the box around all shapes that are no light sources; None without any."""
    corners = []
    for shape in scene.shapes():
        box = shape.bbox()
        if not shape.is_emitter() and box.valid():  # what was merged into another has none
            corners.append([np.ravel(box.min), np.ravel(box.max)])
    if not corners:
        return None
    both = np.array(corners, np.float64)
    lower, upper = both[:, 0].min(axis=0), both[:, 1].max(axis=0)
    if not np.isfinite(both).all():
        return None
    return tuple(lower.tolist()), tuple(upper.tolist())


def _without_traceback(message: str) -> str:
    """One line: of a Python plugin's traceback in it, only what the exception says."""
    before, found, traceback = message.partition("Traceback (most recent call last):")
    if found:
        said = re.findall(r"^[\w.]*(?:Error|Exception): (.*)", traceback, re.MULTILINE)
        message = before + (said[-1] if said else traceback)
    return " ".join(message.split())
