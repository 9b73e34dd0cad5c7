"""Schemas of files: what is written, what is read, and which version that takes."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import pytest

from mi_nerf.base.errors import InputError
from mi_nerf.base.schema import Key, Number, Record, check_version


@dataclass(frozen=True)
class Wheel:
    size: float
    spokes: int = 0


@dataclass(frozen=True)
class Cart:
    name: str
    load: tuple[float, ...] | None = None
    wheel: Wheel | None = None
    lights: bool = False


WHEEL = Record(Wheel, {"size": Key(Number), "spokes": Key(int, absent=0, since=3)})
CART = Record(
    Cart,
    {
        "name": Key(str),
        "load": Key(list | None),
        "wheel": Key(WHEEL, absent=None),
        "lights": Key(bool, absent=False, since=2),
    },
)


@pytest.mark.parametrize(
    ("cart", "written", "version"),
    [
        (Cart("a"), {"name": "a", "load": None, "wheel": None}, 1),
        (
            Cart("a", None, Wheel(2.5)),
            {"name": "a", "load": None, "wheel": {"size": 2.5}},
            1,
        ),
        (
            Cart("a", None, None, True),
            {"name": "a", "load": None, "wheel": None, "lights": True},
            2,
        ),
        (
            Cart("a", None, Wheel(1, 8)),
            {"name": "a", "load": None, "wheel": {"size": 1, "spokes": 8}},
            3,
        ),
    ],
)
def test_a_file_has_the_lowest_version_that_it_needs(
    cart: Cart, written: dict[str, Any], version: int
) -> None:
    assert (CART.write(cart), CART.version(cart)) == (written, version)
    assert CART.read(written) == cart


def test_what_is_absent_has_its_meaning() -> None:
    assert CART.read({"name": "a", "load": [1, 2.5]}) == Cart("a", (1, 2.5))


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"name": ...}, "'cart.name' is missing"),
        ({"naem": "a"}, "unknown key 'cart.naem'"),
        ({"name": 1}, "'cart.name' is 1, expected str"),
        ({"lights": 1}, "'cart.lights' is 1, expected bool"),
        ({"lights": None}, "'cart.lights' is None, expected bool"),
        ({"load": "12"}, "'cart.load' is '12', expected list"),
        ({"wheel": 3}, "cart.wheel is 3, expected an object"),
        ({"wheel": {}}, "'cart.wheel.size' is missing"),
        ({"wheel": {"size": True}}, "'cart.wheel.size' is True, expected int | float"),
    ],
)
def test_damages_are_named(changes: dict[str, Any], said: str) -> None:
    data = {"name": "a", "load": None, **changes}
    data = {key: value for key, value in data.items() if value is not ...}
    with pytest.raises(ValueError, match=said.replace("|", r"\|")):
        CART.read(data, "cart.")


@pytest.mark.parametrize("found", [None, "2", 1.0, True, 0, -1])
def test_no_version(found: Any) -> None:
    with pytest.raises(InputError, match="damaged thing: its format version is"):
        check_version("a", "thing", found, newest=3)
