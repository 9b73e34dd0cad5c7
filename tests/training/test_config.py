"""Settings of a run: by name, by value, and as JSON."""

from __future__ import annotations

import dataclasses
import json
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from mi_nerf.base.errors import InputError
from mi_nerf.fields.fourier import FourierEncoding
from mi_nerf.training.config import TrainConfig, from_json, setting_names, to_json, with_settings
from mi_nerf.training.presets import PRESETS, preset


def value_of(config: Any, name: str) -> Any:
    for part in name.split("."):
        config = getattr(config, part)
    return config


# ---- Assignments -----------------------------------------------------------------


@pytest.mark.parametrize(
    ("assignment", "expected"),
    [
        ("network.width=64", 64),
        ("network.skip=-1", -1),
        ("optimizer.lr=3e-4", 3e-4),
        ("optimizer.lr=1", 1.0),
        ("density.shift=-0.5", -0.5),
        ("steps=100", 100),
        ("steps=none", None),
        ("max_seconds=2.5", 2.5),
        ("occupancy.enabled=false", False),
        ("occupancy.enabled=True", True),
        ("occupancy.enabled=0", False),
        ("occupancy.hull=1", True),
        ("background=black", "black"),
        ("color_activation=auto", "auto"),
        ("color_activation=exp", "exp"),
        ("direction.convention=one", "one"),
        ("box=-1,-2,-3,1,2,3.5", (-1.0, -2.0, -3.0, 1.0, 2.0, 3.5)),
        ("box=null", None),
        ("sampling.rays=512", 512),
        ("sampling.near=0", 0.0),
        ("position=none", None),
    ],
)
@pytest.mark.parametrize("start", PRESETS)
def test_values_of_every_kind(start: str, assignment: str, expected: Any) -> None:
    before = preset(start)
    after = with_settings(before, [assignment])
    name = assignment.partition("=")[0]
    found = value_of(after, name)
    assert found == expected and type(found) is type(expected)
    # Nothing else has changed.
    values, reference = to_json(after), to_json(before)
    for part in name.split(".")[:-1]:
        values, reference = values[part], reference[part]
    assert {k for k in values if values[k] != reference[k]} <= {name.split(".")[-1]}


def test_settings_that_are_found_by_default() -> None:
    """A nested setting that is left open starts from its own defaults."""
    assert preset("nerf").position is None
    config = with_settings(preset("nerf"), ["position.frequencies=7", "position.convention=one"])
    assert config.position == FourierEncoding(frequencies=7, convention="one")
    assert with_settings(preset("paper"), ["position.convention=one"]).position == (
        FourierEncoding(frequencies=10, convention="one")
    )


def test_the_last_assignment_wins() -> None:
    assert with_settings(TrainConfig(), ["seed=1", "seed=2"]).seed == 2


@pytest.mark.parametrize(
    "pair",
    [
        ("network.depth=3", "network.skip=2"),  # skip is 5, and below depth
        ("sampling.samples=100000", "sampling.batch=200000"),
        ("direction.include_input=false", "direction.frequencies=1"),
    ],
)
def test_order_does_not_matter(pair: tuple[str, str]) -> None:
    start = with_settings(TrainConfig(), ["direction.frequencies=0"])
    assert with_settings(start, [*pair]) == with_settings(start, [*reversed(pair)])


def test_all_names_can_be_assigned() -> None:
    """Each name with the text of its own value, or of another where it has none."""
    names = setting_names()
    assert len(names) == len(set(names)) > 40
    others = {
        "steps": "5",
        "max_seconds": "5",
        "box": "0,0,0,1,1,1",
        "sampling.rays": "5",
        "sampling.near": "1",
        "sampling.far": "9",
        "sampling.render_fine": "7",
        "views": "5",
        "images": "exr",
        "grid.finest": "99",
    }
    config = with_settings(TrainConfig(), ["position.frequencies=10", "grid.levels=8"])
    for name in names:
        value = value_of(config, name)
        changed = with_settings(config, [f"{name}={others.get(name, value)}"])
        assert (changed == config) == (value is not None), name


def test_names_cover_the_configuration() -> None:
    """Whatever JSON holds has a name, except for the preset's."""

    def leaves(values: dict[str, Any], prefix: str = "") -> set[str]:
        found = set()
        for key, value in values.items():
            if isinstance(value, dict):
                found |= leaves(value, f"{prefix}{key}.")
            else:
                found.add(prefix + key)
        return found

    config = with_settings(TrainConfig(), ["position.frequencies=10", "grid.levels=8"])
    assert set(setting_names()) | {"preset"} == leaves(to_json(config))


# ---- Refusals ----------------------------------------------------------------------


@pytest.mark.parametrize(
    ("assignments", "said"),
    [
        ("network.width", "settings='network.width': expected key=value"),
        ("=3", "settings='=3': unknown setting"),
        ("network=3", "settings='network=3': unknown setting, expected for example network."),
        ("network.width.x=3", "unknown setting, expected for example network.width"),
        ("network.widht=3", "unknown setting, expected for example network.width"),
        ("width=3", "unknown setting, expected for example network.width"),
        ("preset=paper", "settings='preset=paper': expected preset='paper'"),
        ("network.width=", "settings='network.width=': expected a whole number"),
        ("network.width=1e2", "settings='network.width=1e2': expected a whole number"),
        ("network.width=none", "settings='network.width=none': expected a whole number"),
        ("steps=soon", "settings='steps=soon': expected a whole number or none"),
        ("optimizer.lr=fast", "settings='optimizer.lr=fast': expected a number"),
        ("optimizer.lr=nan", "settings='optimizer.lr=nan': expected a number"),
        ("optimizer.lr=inf", "settings='optimizer.lr=inf': expected a number"),
        ("occupancy.hull=maybe", "settings='occupancy.hull=maybe': expected true or false"),
        ("occupancy.hull=2", "settings='occupancy.hull=2': expected true or false"),
        ("loss=l1", "settings='loss=l1': expected one of auto, mse, relative"),
        ("color_activation=x", "expected one of auto, sigmoid, softplus, exp"),
        ("box=1,2", "settings='box=1,2': expected 6 numbers separated by commas or none"),
        ("box=0,0,0,1,nan,1", "expected 6 numbers separated by commas or none"),
        ("box=0,0,0,1,-1,1", "expected three minima below three maxima"),
        ("network.width=0", "settings='network.width=0': network: width=0, expected at least 1"),
        ("network.skip=9", "skip=9, expected -1 (none) or a layer from 1 to depth-1"),
        ("position.frequencies=25", "frequencies=25, expected 0 to 24"),
        ("seed=-1", "seed=-1, expected a number of at least 0 and below 2147483648"),
        ("steps=0", "steps=0, expected a number of at least 1"),
        ("max_seconds=0", "max_seconds=0.0, expected a number above 0"),
        ("downscale=0", "downscale=0, expected a number of at least 1"),
        ("optimizer.lr=0", "lr=0.0, expected a number above 0"),
        ("optimizer.beta2=1", "beta2=1.0, expected a number of at least 0 and below 1"),
        ("occupancy.resolution=0", "resolution=0, expected a number of at least 1"),
        ("occupancy.every=0", "every=0, expected a number of at least 1"),
        ("occupancy.decay=1.5", "decay=1.5, expected a number of at least 0 and of at most 1"),
        ("sampling.samples=0", "samples=0, expected a number of at least 1"),
        ("sampling.rule=cubic", "expected one of constant, cells, linear"),
        ("sampling.block=0", "block=0, expected a number of at least 1"),
        ("sampling.batch=5", "batch=5, expected at least the samples=64 of one ray"),
        ("density.gain=-1", "gain=-1.0, expected a number above 0"),
        (
            "sampling.near=3 seed=1 sampling.far=2",
            "settings='sampling.near=3 sampling.far=2': near=3.0, expected less than far=2.0",
        ),
    ],
)
def test_refusals(assignments: str, said: str) -> None:
    with pytest.raises(InputError) as refusal:
        with_settings(TrainConfig(), assignments.split())
    message = str(refusal.value)
    assert message.startswith("settings='") and said in message
    assert "\n" not in message


@pytest.mark.slow
@given(st.text(max_size=12), st.text(max_size=12))
def test_any_text_is_either_taken_or_refused(key: str, text: str) -> None:
    for name in (key, "network.width", "optimizer.lr", "box", "occupancy.hull", "loss"):
        try:
            with_settings(TrainConfig(), [f"{name}={text}"])
        except InputError:
            pass


# ---- JSON -----------------------------------------------------------------------------


@pytest.mark.parametrize("name", PRESETS)
def test_presets_come_back_from_json(name: str) -> None:
    config = with_settings(preset(name), ["box=0,0,0,1,1,1", "steps=7", "seed=3", "sampling.far=6"])
    for original in (preset(name), config):
        text = json.dumps(to_json(original), allow_nan=False)
        assert from_json(json.loads(text), "a file") == original
    assert preset(name).preset == name


def test_json_is_complete() -> None:
    values = to_json(TrainConfig())
    assert values.keys() == {f.name for f in dataclasses.fields(TrainConfig)}


def test_missing_keys_get_their_defaults() -> None:
    assert from_json({"network": {"width": 16}}, "a file") == with_settings(
        TrainConfig(), ["network.width=16"]
    )


@pytest.mark.parametrize(
    ("values", "said"),
    [
        ([], "[] in place of the settings of TrainConfig"),
        ({"qqq": 1}, "unknown setting 'qqq'"),
        ({"network": {"qqq": 1}}, "unknown setting 'qqq'"),
        ({"network": 3}, "3 in place of the settings of NetworkConfig"),
        ({"network": None}, "None in place of the settings of NetworkConfig"),
        ({"seed": "1"}, "seed='1', expected a whole number"),
        ({"seed": 1.5}, "seed=1.5, expected a whole number"),
        ({"seed": True}, "seed=True, expected a whole number"),
        ({"seed": None}, "seed=None, expected a whole number"),
        ({"seed": -1}, "seed=-1, expected a number of at least 0"),
        ({"loss": "l1"}, "loss='l1', expected one of auto, mse, relative"),
        ({"occupancy": {"enabled": 1}}, "enabled=1, expected true or false"),
        ({"optimizer": {"lr": True}}, "lr=True, expected a number"),
        ({"optimizer": {"lr": float("nan")}}, "lr=nan, expected a number"),
        ({"box": [1, 2, 3]}, "box=(1, 2, 3), expected 6 numbers"),
        ({"box": [0, 0, 0, 1, 1, "1"]}, "expected 6 numbers"),
    ],
)
def test_json_that_is_no_configuration(values: Any, said: str) -> None:
    with pytest.raises(InputError) as refusal:
        from_json(values, "run/config.json")
    message = str(refusal.value)
    assert message.startswith("run/config.json: not a training configuration of this version: ")
    assert said in message


def test_unknown_preset() -> None:
    with pytest.raises(InputError, match="preset .qqq.: unknown, expected one of nerf, fast,"):
        preset("qqq")
