"""The schema of field files, and that newer ones are told apart from damaged ones."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import pytest

from mi_nerf import FieldFile, InputError, NeuralFieldConfig, load_field, save_field
from mi_nerf.base.schema import Key, Record
from mi_nerf.base.tensor_file import read_metadata, read_tensors, write_tensors
from mi_nerf.fields.network import initial_weights
from mi_nerf.formats import field_file
from tests.support.fields import SMALL, small_file


def records(record: Record) -> list[Record]:
    """A record and those in it."""
    inner = [records(k.kind) for k in record.keys.values() if isinstance(k.kind, Record)]
    return [record, *sum(inner, [])]


def test_the_schema_knows_all_of_a_field() -> None:
    """A field of these dataclasses that no key stands for would be lost."""
    found = records(field_file._FIELD)
    assert len({record.make for record in found}) == 5
    for record in found:
        assert [field.name for field in dataclasses.fields(record.make)] == list(record.keys)


def rewritten(path: Path, version: int, **changes: Any) -> Path:
    """The same file, of another version and with changes of its description."""
    arrays, description = read_tensors(path, kind="field", newest=field_file.NEWEST)
    write_tensors(path, arrays, kind="field", version=version, description=description | changes)
    return path


def test_newer_is_not_damaged(tmp_path: Path) -> None:
    newest = field_file.NEWEST
    path = rewritten(small_file(tmp_path), newest + 1, lens="fisheye")
    said = f"newer than this program: field file of format version {newest + 1}, this mi_nerf"
    with pytest.raises(InputError, match=said):
        load_field(path)
    path = rewritten(small_file(tmp_path), newest, lens="fisheye")
    with pytest.raises(InputError, match="damaged field description: unknown key 'lens'"):
        load_field(path)


def test_files_of_before_the_first_version(tmp_path: Path) -> None:
    """They called the kind otherwise, and lack what was not there yet."""
    path = small_file(tmp_path)
    wanted = load_field(path)
    description = read_tensors(path, kind="field", newest=1)[1]
    field = {k: v for k, v in description["field"].items() if k not in ("grid", "ndc")}
    field["network"].pop("feature_relu")
    march = {name: description["march"][name] for name in ("samples", "near", "far")}
    found = load_field(rewritten(path, 1, field=field | {"kind": "fourier"}, march=march))
    assert (found.config, found.march) == (wanted.config, wanted.march)


def test_a_key_that_is_added_raises_the_version_where_it_is_used(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    @dataclasses.dataclass(frozen=True)
    class Later(NeuralFieldConfig):
        lens: str = "none"

    later = Record(Later, {**field_file._FIELD.keys, "lens": Key(str, absent="none", since=2)})
    monkeypatch.setattr(field_file, "_FIELD", later)
    monkeypatch.setattr(field_file, "NEWEST", 2)
    values = {f.name: getattr(SMALL, f.name) for f in dataclasses.fields(SMALL)}
    for lens, version in (("none", "1"), ("fisheye", "2")):
        config = Later(**values, lens=lens)
        path = tmp_path / f"{lens}.safetensors"
        save_field(path, FieldFile(config, initial_weights(config.shapes(), 0)))
        assert read_metadata(path)["version"] == version
        assert load_field(path).config == config
    monkeypatch.undo()
    assert load_field(tmp_path / "none.safetensors").config == SMALL
    with pytest.raises(InputError, match="fisheye.*: newer than this program"):
        load_field(tmp_path / "fisheye.safetensors")
