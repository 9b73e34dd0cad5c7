"""Mitsuba XML scenes: parsed, adjusted, loaded, with errors of one line."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from xml.sax.saxutils import quoteattr

import numpy as np

from ..base.errors import InputError
from .instancing import copy_instances
from .merging import merge_meshes
from .provenance import digest, files_of
from .refusals import check_file, refusal
from .spectra import spectra_as_values
from .substitutes import add_integrator, substitute

_NO_MERGE = "Mesh::merge()"  # what Mitsuba names when it has begun to merge what it should not

Bounds = tuple[tuple[float, float, float], tuple[float, float, float]]


class SceneFile:
    """A parsed scene that is not loaded yet. A Mitsuba variant must be set.

    It is brought up to the present version of Mitsuba's format before anything is read or
    changed, so names are those of today: ``to_world``, ``hide_emitters``.

    Attributes:
        notes: What was replaced by what, a line each.

    Raises:
        InputError: if the file is missing, or Mitsuba cannot parse it.
    """

    def __init__(self, path: str | Path, parameters: Mapping[str, str] | None = None) -> None:
        """Parses ``path`` with values for its ``$parameters``."""
        import mitsuba as mi

        self.path = Path(path)
        self.parameters = dict(parameters or {})
        self.notes: list[str] = []
        self._defaults: dict[str, str | None] = {}  # as far as anybody has asked
        check_file(self.path)
        self._absolute = Path(os.path.abspath(self.path))
        # Beside the file, or beside what it is a link to; then what its <path>s add.
        self._folders = [str(self._absolute.parent), str(self.path.resolve().parent)]
        self._config = mi.parser.ParserConfig(mi.variant())
        with self._one_line_errors(), self._search_path():
            parsed = mi.parser.parse_file(self._config, str(self._absolute), **self.parameters)
            self._as_parsed = mi.parser.ParserState(parsed)
            if parsed.root.type != mi.ObjectType.Scene:
                raise InputError(f"{path}: expected <scene> as the outermost element")
            mi.parser.transform_upgrade(self._config, parsed)
            mi.parser.transform_resolve(self._config, parsed)
            _tell_names(parsed)
            if "spectral" not in mi.variant():
                self.notes += spectra_as_values(parsed)
        self._state = parsed

    def default(self, name: str) -> str | None:
        """The value of a ``$parameter``: as given, or by the file's own ``<default>``."""
        if name in self.parameters:
            return self.parameters[name]
        if name not in self._defaults:
            self._defaults[name] = self._default(name)
        return self._defaults[name]

    def _default(self, name: str) -> str | None:
        """What the file itself says, which takes parsing it."""
        import mitsuba as mi

        # Mitsuba's parser takes much that is no XML, and does not tell defaults: it is asked what
        # it puts for the parameter in a scene that includes the file. The first default counts.
        file = quoteattr(str(self._absolute).replace("$", "\\$"))
        asking = (
            f'<scene version="3.0.0"><include filename={file}/>'
            f'<default name="{name}" value=""/>'
            f'<shape type="cube"><string name="value" value="${name}"/></shape></scene>'
        )
        config = mi.parser.ParserConfig(self._config.variant)
        config.max_include_depth += 1
        with self._one_line_errors(), self._search_path():
            state = mi.parser.parse_string(config, asking, **self.parameters)
        return str(state.nodes[len(state.nodes) - 1].props["value"]) or None

    def plugins(self, kind: str) -> list[Any]:
        """The properties of all plugins of a kind, such as ``"Sensor"``."""
        import mitsuba as mi

        wanted = getattr(mi.ObjectType, kind)
        return [node.props for node in self._state.nodes if node.type == wanted]

    def substitute(self, *kinds: str) -> None:
        """Replaces plugins of kinds that do not matter here, where Mitsuba does not know them.

        What was replaced is added to ``notes``. See :func:`.substitutes.substitute`.
        """
        self.notes += substitute(self._state, kinds)

    def complete(self) -> None:
        """Gives a scene that has no integrator the usual one, which is added to ``notes``."""
        self.notes += add_integrator(self._state)

    @property
    def state(self) -> Any:
        """What Mitsuba's parser found, upgraded and resolved; changes count for the next load."""
        return self._state

    def load(self, *, merge: bool = True) -> Any:
        """Creates the scene.

        Args:
            merge: Meshes of one material become one, which renders faster, unless Mitsuba finds
                that they do not go together. The order of shapes is always the same.

        Raises:
            InputError: with what Mitsuba says, if it refuses.
        """
        with self._one_line_errors(), self._search_path():
            if not merge:
                return self._instantiate(merge=False)
            try:
                return self._instantiate(merge=True)
            except RuntimeError as error:
                if _NO_MERGE not in str(error):
                    raise
            return self._instantiate(merge=False)

    def _instantiate(self, *, merge: bool) -> Any:
        import mitsuba as mi

        state = mi.parser.ParserState(self._state)
        copy_instances(state)
        mi.parser.transform_merge_equivalent(self._config, state)
        if merge:
            merge_meshes(state)
        scene = mi.parser.instantiate(self._config, state)
        return scene[0] if isinstance(scene, list) else scene

    def files(self) -> list[Path]:
        """The XML files and what they name, but for spectra; see :func:`.provenance.files_of`."""
        with self._one_line_errors(), self._search_path():
            return files_of(self._as_parsed)

    def digest(self) -> str:
        """SHA-256 of the scene: its XML, parameters, and the files that it reads."""
        with self._one_line_errors(), self._search_path():
            return digest(self._as_parsed, self.parameters)

    @contextmanager
    def _one_line_errors(self) -> Iterator[None]:
        """Says in one line what Mitsuba refuses; a fault of a Python plugin comes as it is."""
        try:
            yield
        except UnicodeDecodeError as error:  # in a name that Mitsuba wants to tell
            raise InputError(
                f"{self.path}: holds bytes that are no UTF-8, expected that or another encoding "
                "declared in its first line"
            ) from error
        except RuntimeError as error:  # for all that can be wrong, what plugins raise included
            message = refusal(str(error))
            if message is None:
                raise
            message = message.replace(str(self._absolute), self.path.name)
            raise InputError(f"{self.path}: Mitsuba cannot load this scene: {message}") from error

    @contextmanager
    def _search_path(self) -> Iterator[None]:
        """Relative names in the scene are looked up in its own folders first."""
        import mitsuba as mi

        resolver = mi.file_resolver()
        before = [str(folder) for folder in resolver]
        resolver.clear()
        for folder in (*self._folders, *before):
            resolver.append(folder)
        try:
            yield
        finally:
            folders = [str(folder) for folder in resolver]
            self._folders = folders[: len(folders) - len(before)]
            resolver.clear()
            for folder in before:
                resolver.append(folder)


@contextmanager
def quiet() -> Iterator[None]:
    """Without Mitsuba's warnings about sensors and samplers that are replaced anyway."""
    import mitsuba as mi

    level = mi.log_level()
    mi.set_log_level(mi.LogLevel.Error)
    try:
        yield
    finally:
        mi.set_log_level(level)


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


def _tell_names(state: Any) -> None:
    """Gives objects whose names are in no known encoding others, which Python can tell."""
    for i, node in enumerate(state.nodes):
        try:
            node.props.id()
        except UnicodeDecodeError:
            node.props.set_id(f"unnamed_{i}")
