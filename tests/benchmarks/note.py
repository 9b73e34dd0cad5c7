"""Writes down a figure that another command has measured, on this machine with these sources.

    python -m tests.benchmarks.note kept "what=patches of rays" "how=60 s, seed 0" \\
        --figures "without=30.1 dB" "with=30.9 dB" --command "mi-nerf train …"

What stands before the equals signs are the columns of the table that shows the file, as its
first comment in the documents names them.
"""

from __future__ import annotations

import argparse

from mi_nerf.base.errors import InputError
from mi_nerf.base.variants import choose_variant
from tests.benchmarks.results import TRAINING, Figure, Row, add_options, save


def main() -> None:
    """Adds a row to a file, in place of one with the same labels."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("name", help="of the file in docs/results")
    parser.add_argument("labels", nargs="+", help="name=words")
    parser.add_argument("--figures", nargs="+", required=True, help="name=number unit")
    parser.add_argument("--command", required=True, help="what has measured them")
    parser.add_argument("--parts", nargs="+", default=TRAINING, help="of mi_nerf that matter")
    parser.add_argument("--seeds", type=int, nargs="*", default=[])
    parser.add_argument("--variant")
    add_options(parser)
    options = parser.parse_args()
    figures = {name: figure(text) for name, text in map(_named, options.figures)}
    row = Row(dict(map(_named, options.labels)), figures, seeds=tuple(options.seeds))
    variant, parts = choose_variant(options.variant), tuple(options.parts)
    save(options.name, [row], options, variant, parts, command=options.command)


def figure(text: str) -> Figure:
    """A number, and its unit behind a space."""
    number, _, unit = text.partition(" ")
    try:
        return Figure(float(number), unit)
    except ValueError:
        raise InputError("{}: expected a number, then its unit if it has one", text) from None


def _named(text: str) -> tuple[str, str]:
    name, equals, value = text.partition("=")
    if not name or not equals or not value:
        raise InputError("{}: expected name=value", text)
    return name, value


if __name__ == "__main__":
    main()
