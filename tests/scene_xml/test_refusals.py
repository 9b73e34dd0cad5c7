"""Whose fault it was, and how it is told."""

from __future__ import annotations

from pathlib import Path

import pytest

from mi_nerf.base.errors import InputError
from mi_nerf.scene_xml.refusals import check_file, refusal, refused_rendering


def test_what_mitsuba_says_is_one_line_without_places_in_its_sources() -> None:
    said = "[parser.cpp:451] Error while loading a.xml:\n  - [properties.h:7] wrong [PLYMesh] file"
    assert refusal(said) == "Error while loading a.xml: - wrong [PLYMesh] file"


def test_of_nested_includes_the_innermost_is_told() -> None:
    said = "while loading a.xml: while processing <include>:\nwhile loading b.xml: it is wrong"
    assert refusal(said) == "while loading b.xml: it is wrong"


@pytest.mark.parametrize(
    ("last", "told"),
    [
        ("mi_nerf.base.errors.InputError: no way", "At x: no way"),
        ("Exception: no way", "At x: no way"),
        ("KeyError: 'a'", None),
        ("File x, line 3", None),
    ],
)
def test_plugins_in_python(last: str, told: str | None) -> None:
    assert refusal(f"At x: Traceback (most recent call last):\n  File y\n{last}") == told


def wrapped(cause: BaseException | None) -> RuntimeError:
    error = RuntimeError("drjit.custom(...): error while performing a custom operation")
    error.__cause__ = cause
    return error


def test_pictures_that_mitsuba_cannot_draw() -> None:
    cause = RuntimeError("[IrregularSpectrum] IrregularSpectrum::eval(): not\n implemented!")
    expected = (
        "Mitsuba cannot render this scene: "
        "[IrregularSpectrum] IrregularSpectrum::eval(): not implemented!"
    )
    assert refused_rendering(wrapped(cause)) == refused_rendering(cause) == expected


@pytest.mark.parametrize(
    "cause", [None, KeyError("[A] b"), RuntimeError("no name"), NotImplementedError("[A] b")]
)
def test_faults_of_programs_are_none_of_mitsuba(cause: BaseException | None) -> None:
    assert refused_rendering(wrapped(cause)) is None


def test_what_is_no_file(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="is a folder, expected a Mitsuba XML scene"):
        check_file(tmp_path)
    with pytest.raises(InputError, match="not found, expected a Mitsuba XML scene"):
        check_file(tmp_path / "nothing.xml")
    with pytest.raises(InputError, match="cannot be read: File name too long"):
        check_file(tmp_path / ("n" * 300))
    with pytest.raises(InputError, match="expected a name in UTF-8"):
        check_file(tmp_path / "\udcff.xml")
    with pytest.raises(InputError, match="cannot be read: embedded null"):
        check_file(tmp_path / "a\0b")
    with pytest.raises(InputError, match="cannot be read: Not a directory"):
        (tmp_path / "file").touch()
        check_file(tmp_path / "file" / "scene.xml")
