"""Dataclasses of plain values: checked, built from JSON, and changed by text.

Plain values are what JSON knows: numbers, truth values, texts, tuples of them, and
dataclasses of plain values. Type hints say what is expected.
"""

from __future__ import annotations

import dataclasses
import math
import types
import typing
from collections.abc import Iterator
from typing import Any, Literal


def require(
    settings: Any,
    names: str,
    *,
    at_least: float = -math.inf,
    above: float = -math.inf,
    at_most: float = math.inf,
    below: float = math.inf,
) -> None:
    """Refuses numbers out of range, infinity and NaN; ``None`` stands for no number."""
    limits = {"of at least": at_least, "above": above, "of at most": at_most, "below": below}
    for name in names.split():
        value = getattr(settings, name)
        if value is None or (at_least <= value <= at_most and above < value < below):
            continue
        expected = " and ".join(f"{k} {v}" for k, v in limits.items() if math.isfinite(v))
        raise ValueError(f"{name}={value}, expected a number {expected}")


def build(cls: Any, data: Any) -> Any:
    """A ``cls`` from a dictionary of plain values.

    Raises:
        ValueError: for an unknown setting, or a value of the wrong kind or out of range.
    """
    if not isinstance(data, dict):
        raise ValueError(f"{data!r} in place of the settings of {cls.__name__}")
    hints = typing.get_type_hints(cls)
    values = {}
    for name, value in data.items():
        if name not in hints:
            raise ValueError(f"unknown setting '{name}'")
        if isinstance(value, list):
            value = tuple(value)
        nested = _nested(hints[name])
        if nested is not None and not (value is None and _fits(None, hints[name])):
            value = build(nested, value)
        elif not _fits(value, hints[name]):
            raise ValueError(f"{name}={value!r}, expected {_describe(hints[name])}")
        values[name] = value
    return cls(**values)


def assign(values: dict[str, Any], cls: Any, path: list[str], text: str) -> None:
    """Puts the value that ``text`` stands for into ``values``, plain values of a ``cls``.

    Raises:
        KeyError: if there is no such setting.
        ValueError: if the text is not of its kind.
    """
    name, rest = path[0], path[1:]
    hint = typing.get_type_hints(cls)[name]
    nested = _nested(hint)
    if nested is not None and rest:
        if values[name] is None:
            values[name] = dataclasses.asdict(nested())
        assign(values[name], nested, rest, text)
    elif rest:
        raise KeyError(name)
    elif text.lower() in ("none", "null") and _fits(None, hint):
        values[name] = None
    elif nested is not None:
        raise KeyError(name)
    else:
        values[name] = _parse(text, hint)


def as_text(value: Any, form: str = "") -> str:
    """A plain value as :func:`assign` reads it; ``form`` is how real numbers are written."""
    if isinstance(value, list | tuple):
        return ",".join(as_text(v, form) for v in value)
    if isinstance(value, float):
        return format(value, form)
    return "none" if value is None else str(value).lower()


def leaves(values: dict[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    """The plain values of nested dictionaries, each with its dotted name."""
    for name, value in values.items():
        if isinstance(value, dict):
            yield from leaves(value, f"{prefix}{name}.")
        else:
            yield f"{prefix}{name}", value


def leaf_names(cls: Any, prefix: str = "") -> list[str]:
    """The dotted names of all plain values of a dataclass and those it holds."""
    names = []
    for name, hint in typing.get_type_hints(cls).items():
        nested = _nested(hint)
        if nested is not None:
            names += leaf_names(nested, f"{prefix}{name}.")
        else:
            names.append(prefix + name)
    return names


def _nested(hint: Any) -> Any:
    """The dataclass that a setting holds, or may hold; ``None`` for plain values."""
    for option in (hint, *typing.get_args(hint)):
        if dataclasses.is_dataclass(option):
            return option
    return None


def _options(hint: Any) -> tuple[Any, ...]:
    """The alternatives of a union, or the type itself."""
    is_union = typing.get_origin(hint) in (typing.Union, types.UnionType)
    return typing.get_args(hint) if is_union else (hint,)


def _parse(text: str, hint: Any) -> Any:
    """Reads ``text`` as the type ``hint``.

    Raises:
        ValueError: if it is none, saying what was expected.
    """
    for option in _options(hint):
        try:
            value: Any = text
            if option is bool:
                value = {"true": True, "1": True, "false": False, "0": False}[text.lower()]
            elif option in (int, float):
                value = option(text)
            elif typing.get_origin(option) is tuple:
                value = tuple(float(part) for part in text.split(","))
        except (ValueError, KeyError):
            continue
        if _fits(value, option):
            return value
    raise ValueError(f"expected {_describe(hint)}")


def _fits(value: Any, hint: Any) -> bool:
    """Whether a plain value is of the type ``hint``; infinity and NaN are no numbers."""
    for option in _options(hint):
        parts = typing.get_args(option)
        if typing.get_origin(option) is Literal:
            fits = value in parts
        elif typing.get_origin(option) is tuple:
            fits = isinstance(value, tuple) and len(value) == len(parts)
            fits = fits and all(_fits(v, part) for v, part in zip(value, parts, strict=True))
        elif option is float:
            is_number = isinstance(value, (int, float)) and not isinstance(value, bool)
            fits = is_number and math.isfinite(value)
        elif option is int:
            fits = isinstance(value, int) and not isinstance(value, bool)
        else:
            fits = isinstance(value, option)
        if fits:
            return True
    return False


def _describe(hint: Any) -> str:
    """A type in words."""
    words = {int: "a whole number", float: "a number", bool: "true or false", str: "a text"}
    parts, literals = [], []
    for option in _options(hint):
        if typing.get_origin(option) is Literal:
            literals += [str(v) for v in typing.get_args(option)]
        elif typing.get_origin(option) is tuple:
            parts.append(f"{len(typing.get_args(option))} numbers separated by commas")
        else:
            parts.append(words.get(option, "none"))
    return " or ".join(([f"one of {', '.join(literals)}"] if literals else []) + parts)
