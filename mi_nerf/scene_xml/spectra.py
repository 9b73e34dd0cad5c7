"""Spectra for variants that know colours only.

Mitsuba turns ``<spectrum value="400:0.1, …">`` into a colour there, but refuses to draw its
spectra that are plugins: ``blackbody``, ``regular`` and ``irregular``. Their values are given to
it in the other way.
"""

from __future__ import annotations

import re
from typing import Any

import numpy as np

from .instancing import children

_LIGHT_SPEED, _PLANCK, _BOLTZMANN = 299792458.0, 6.62607015e-34, 1.380649e-23  # SI
_VISIBLE = 360.0, 830.0  # nm
_STEPS = 95
_RANGE = "wavelength_min", "wavelength_max"

Array = np.ndarray[Any, Any]
Values = tuple[Array, Array]


def spectra_as_values(state: Any) -> list[str]:
    """Puts values in place of plugins that are spectra; says so, a line for each kind.

    Args:
        state: A ``mi.parser.ParserState``, upgraded, whose references are resolved.
    """
    import mitsuba as mi

    found: dict[int, Values] = {}
    for i, node in enumerate(state.nodes):
        if node.type == mi.ObjectType.Texture and (pairs := _values(node.props)) is not None:
            found[i] = pairs
    if not found:
        return []
    spectrum = type(_parsed("1"))  # a variant hides it behind a class of the same name
    notes = []
    for node in state.nodes:
        for key, index in children(node.props):
            if index in found:
                wavelengths, values = found[index]
                node.props[key] = spectrum(wavelengths.tolist(), values.tolist())
                name = state.nodes[index].props.plugin_name()
                notes.append(f"spectrum '{name}': not known to colours, taken as the colour it has")
    return list(dict.fromkeys(notes))


def planck(wavelengths: Array, temperature: float) -> Array:
    """What a black body emits, W/(m² sr nm), at wavelengths in nm and a temperature in K.

    Planck's law, L = 2hc²/λ⁵ / (exp(hc/λkT) − 1).
    """
    meters = np.asarray(wavelengths, np.float64) * 1e-9
    exponent = _PLANCK * _LIGHT_SPEED / (meters * _BOLTZMANN * temperature)
    return 1e-9 * 2 * _PLANCK * _LIGHT_SPEED**2 / meters**5 / np.expm1(exponent)


def _values(props: Any) -> Values | None:
    """Wavelengths and values of a plugin that is a spectrum; ``None`` if Mitsuba shall judge it."""
    name, keys = props.plugin_name(), set(props.keys())
    if name == "blackbody" and "temperature" in keys <= {"temperature", *_RANGE}:
        given = [float(props.get(key, end)) for key, end in zip(_RANGE, _VISIBLE, strict=True)]
        first, last = np.clip(given, *_VISIBLE).tolist()
        wavelengths = np.linspace(first, last, _STEPS)
        return wavelengths, planck(wavelengths, float(props["temperature"]))
    if name == "irregular" and keys == {"wavelengths", "values"}:
        return _paired(_numbers(props["wavelengths"]), _numbers(props["values"]))
    if name == "regular" and keys == {"values", *_RANGE}:
        values = _numbers(props["values"])
        first, last = (float(props[key]) for key in _RANGE)
        return None if values is None else _paired(np.linspace(first, last, len(values)), values)
    return None


def _paired(wavelengths: Any, values: Any) -> Values | None:
    if wavelengths is None or values is None or len(wavelengths) != len(values) or len(values) < 2:
        return None
    return wavelengths, values


def _numbers(text: Any) -> Array | None:
    try:
        return np.array([float(word) for word in re.split(r"[\s,]+", str(text).strip())])
    except ValueError:
        return None


def _parsed(value: str) -> Any:
    """A spectrum as Mitsuba's parser makes it."""
    import mitsuba as mi

    content = f'<texture version="3.0.0" type="d65"><spectrum name="x" value="{value}"/></texture>'
    config = mi.parser.ParserConfig(mi.variant())
    return mi.parser.parse_string(config, content).root.props["x"]
