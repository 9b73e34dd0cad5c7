"""Which light sources a camera sees: all, none, or those that are part of the object.

A light source that is hidden lights the scene, and rays of the camera go on behind it. Only
shapes that shine (``area``, ``directionalarea``) and what surrounds the scene (``constant``,
``envmap``, ``sunsky``) can be seen at all; points, spots and beams are never seen.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import drjit as dr
import numpy as np

from ..base.arrays import Mask
from ..base.errors import InputError, Option

ALL = "all"
_MENTIONED = 4  # names in a line


class Hidden:
    """The light sources of a scene that cameras do not see. A Mitsuba variant must be set."""

    def __init__(self, scene: Any, hide: bool, keep: Iterable[str] = ()) -> None:
        """Decides for each light source of ``scene``.

        Args:
            hide: Whether any are hidden.
            keep: IDs of those that are seen all the same, their own or their shapes'; or ``all``.

        Raises:
            InputError: for the ID of something else.
        """
        # A light source that outlives its scene would refer to a shape that is gone.
        self._scene = scene
        emitters, kept = scene.emitters(), set(keep)
        _check(kept, emitters)
        self.chosen, self.by_name = bool(kept), bool(kept) and ALL not in kept
        """Whether the user has chosen, and one by one."""
        self._hidden = [hide and ALL not in kept and not kept & _names(e) for e in emitters]
        pairs = list(zip(emitters, self._hidden, strict=True))
        shapes = [is_hidden for e, is_hidden in pairs if e.get_shape() is not None]
        around = [is_hidden for e, is_hidden in pairs if e.is_environment()]
        self.environment = any(around)
        """Whether what surrounds the scene is hidden."""
        self.any = any(shapes + around)
        """Whether anything is hidden that could be seen."""
        self.partly = self.any and not all(shapes + around)
        """Whether something else is seen."""
        self._every_shape, self._some_shape = all(shapes), any(shapes)
        self._table: Any = None

    @property
    def note(self) -> str:
        """Which shapes are not seen because they shine, for people; nothing without any."""
        pairs = zip(self._scene.emitters(), self._hidden, strict=True)
        unseen = [e for e, is_hidden in pairs if is_hidden and e.get_shape() is not None]
        if not unseen:
            return ""
        named = list(dict.fromkeys(filter(None, map(_best_name, unseen))))[:_MENTIONED]
        more = len(unseen) - len(named)
        others = f"{more} {'more' if named else 'without a name'}" if more else ""
        which = " and ".join(filter(None, [", ".join(named), others]))
        return f"lights that are not seen: {which} (--keep-emitters ID… or all shows them)"

    def keeps(self, shape: Any) -> bool:
        """Whether a shape that shines was chosen to be seen, as part of the object."""
        emitter = shape.emitter()
        pairs = zip(self._scene.emitters(), self._hidden, strict=True)
        return self.chosen and any(e is emitter and not is_hidden for e, is_hidden in pairs)

    def __call__(self, emitter: Any) -> Mask:
        """Whether light sources that rays have met, as ``EmitterPtr``, are hidden shapes."""
        import mitsuba as mi

        if not self._some_shape:
            return mi.Bool(False)
        if self._every_shape:
            return emitter != None  # noqa: E711
        index = dr.reinterpret_array(mi.UInt32, emitter)
        return dr.gather(mi.Bool, self._flags(), index, emitter != None)  # noqa: E711

    def _flags(self) -> Any:
        """One truth value for each number by which Dr.Jit knows a light source."""
        import mitsuba as mi

        if self._table is None:
            numbers = [
                int(np.array(dr.reinterpret_array(mi.UInt32, mi.EmitterPtr(e)))[0])
                for e in self._scene.emitters()
            ]
            flags = np.zeros(max(numbers) + 1, bool)
            flags[numbers] = self._hidden
            self._table = mi.Bool(flags)
        return self._table


def _check(kept: set[str], emitters: list[Any]) -> None:
    """Refuses IDs of what is no light source, or none that can be seen."""
    seen = [e for e in emitters if e.get_shape() is not None or e.is_environment()]
    known = set().union(*(_names(e) for e in seen)) | {ALL}
    names = ", ".join(dict.fromkeys(filter(None, map(_best_name, seen))))
    for name in sorted(kept - known):
        known_otherwise = any(name in _names(e) for e in emitters)
        raise InputError(
            "{}: {}, expected {}",
            Option("keep_emitters", name),
            "cannot be seen, it is no surface" if known_otherwise else "no light source",
            (f"{ALL} or {names}" if names else ALL)
            if seen
            else "none, no light source can be seen",
        )


def _names(emitter: Any) -> set[str]:
    shape = emitter.get_shape()
    return {emitter.id()} | ({shape.id()} if shape is not None else set())


def _best_name(emitter: Any) -> str:
    """The name that people know a light source by: that of its shape."""
    shape = emitter.get_shape()
    return str(emitter.id() if shape is None else shape.id() or emitter.id())
