"""``python -m tests.hard_cases``: the figures of docs/stability.md."""

from __future__ import annotations

import argparse
import re
from typing import Any

from mi_nerf.base.variants import array_module, choose_variant
from tests.benchmarks.results import TRAINING, Figure, Row, add_options, save
from tests.hard_cases import fields
from tests.hard_cases.cases import CASES


def main() -> None:
    """Measures every case."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--variant")
    add_options(parser)
    options = parser.parse_args()
    variant = choose_variant(options.variant)
    ad = array_module(variant)
    cases, sheets = _cases(ad), _sheets(ad)
    for row in (*cases, *sheets):
        found = ", ".join(f"{name} {figure.value:.3g}" for name, figure in row.figures.items())
        print(f"{', '.join(filter(None, row.labels.values()))}: {found}")
    save("hard_cases", cases, options, variant, TRAINING, whole=True)
    save("thin_sheet", sheets, options, variant, TRAINING, whole=True)


def _cases(ad: Any) -> list[Row]:
    rows = []
    for case in CASES:
        head = {"row": str(case.row), "case": case.name, "formula": case.naive}
        for finding in case.measure(ad):
            labels = {**head, "measured": finding.what, "test": f"`{case.test}`"}
            figures = {"usual": Figure(finding.naive), "ours": Figure(finding.ours)}
            rows.append(Row(labels, figures))
            head = dict.fromkeys(head, "")
    return rows


def _sheets(ad: Any) -> list[Row]:
    rows = []
    for thickness in fields.THICKNESSES:
        errors = fields.sheet_errors(ad, thickness)
        figures = {
            re.sub(r"\W+", "_", name): Figure(opacity) for name, (opacity, _) in errors.items()
        }
        rows.append(Row({"thickness": f"{thickness:g}"}, figures))
    return rows


if __name__ == "__main__":
    main()
