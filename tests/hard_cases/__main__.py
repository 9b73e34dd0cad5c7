"""``python -m tests.hard_cases``: both tables of docs/stability.md."""

from __future__ import annotations

import argparse
import math

from mi_nerf.base.variants import array_module, choose_variant
from tests.hard_cases import fields
from tests.hard_cases.cases import CASES


def main() -> None:
    """Measures every case."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--variant")
    ad = array_module(choose_variant(parser.parse_args().variant))
    print("| row | case | usual formula | measured | usual | mi_nerf | test |")
    print("|---|---|---|---|---|---|---|")
    for case in CASES:
        head = f"| {case.row} | {case.name} | {case.naive} "
        for finding in case.measure(ad):
            print(
                f"{head}| {finding.what} | {number(finding.naive)} | {number(finding.ours)} "
                f"| `{case.test}` |"
            )
            head = "| | | "
    print("\n| thickness of the sheet | 64 even samples | 192 even | 64 + 128 hierarchical |")
    print("|---|---|---|---|")
    for thickness in fields.THICKNESSES:
        errors = [f"{opacity:.2g}" for opacity, _ in fields.sheet_errors(ad, thickness).values()]
        print(f"| {thickness:g} | {' | '.join(errors)} |")


def number(value: float) -> str:
    """As the tables print it."""
    if not math.isfinite(value):
        return "NaN" if math.isnan(value) else "∞" if value > 0 else "−∞"
    return "0" if value == 0 else f"{value:.3g}"


if __name__ == "__main__":
    main()
