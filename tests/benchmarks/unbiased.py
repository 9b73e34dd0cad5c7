"""How far means of nerf_tracking are from closed forms, in standard errors.

    python -m tests.benchmarks.unbiased --paths 20

Each field of ``tests/test_closed_form.py`` is seen along 50 rays, with millions of paths in
all. Without bias, the z of a ray's mean is normally distributed: its root mean square over
rays is about 1, whatever the number of paths.
"""

from __future__ import annotations

import argparse
import time

import numpy as np

from mi_nerf.base.variants import array_module, choose_variant
from mi_nerf.estimators.majorant import Majorants
from mi_nerf.fields.closed_form import closed_form
from tests.benchmarks import machine
from tests.benchmarks.results import Figure, Row, add_options, save
from tests.estimators.test_tracking import estimates, z_scores
from tests.fields.test_closed_form import JUMPS, VALUES, directed, within
from tests.support import closed_forms as oracle

FIELDS = {**VALUES, **{f"{kind}, edge 0": values for kind, values in JUMPS.items()}}
RAYS = 50
PATHS = 1 << 14  # a ray, at a time


def main() -> None:
    """Prints a table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--paths", type=float, default=20, help="millions for each field")
    parser.add_argument("--variant")
    add_options(parser)
    options = parser.parse_args()
    variant = choose_variant(options.variant)
    print(f"{machine()}, {variant}\n")
    print("| field | million paths | rms z of opacity | z of the mean opacity | seconds |")
    print("|---|---|---|---|---|")
    repeats = max(1, round(options.paths * 1e6 / (RAYS * PATHS)))
    rows = []
    for name in FIELDS:
        start = time.perf_counter()
        z, together = scores(array_module(variant), name, repeats)
        paths = repeats * RAYS * PATHS / 1e6
        seconds = time.perf_counter() - start
        print(f"| {name} | {paths:.1f} | {z:.2f} | {together:+.2f} | {seconds:.0f} |")
        figures = {
            "rms_z": Figure(z),
            "z_of_mean": Figure(together),
            "million_paths": Figure(paths),
            "seconds": Figure(seconds, "s"),
        }
        rows.append(Row({"field": name}, figures))
    save("unbiased", rows, options, variant, ("estimators", "fields"), whole=True)


def scores(ad: object, name: str, repeats: int) -> tuple[float, float]:
    """Root mean square of the rays' z, and the z of the mean over all rays that hit."""
    kind = name.partition(",")[0]
    field = closed_form(kind, FIELDS[name], ad.TensorXf)  # type: ignore[attr-defined]
    o, d = directed(RAYS)
    exact = oracle.seen(kind, oracle.values_of(field.config), within(field, o, d))[:, 3]
    majorants = Majorants.seen(field, None, ad.Float)  # type: ignore[attr-defined]
    blocks = [
        estimates(ad, field, o, d, majorants, PATHS, grow=True, seed=5 + k)[0][3]
        for k in range(repeats)
    ]
    opacity = np.concatenate(blocks, axis=-1)
    z = z_scores(opacity[None], exact[:, None])[0]
    error = opacity.std(axis=-1) / np.sqrt(opacity.shape[-1])
    hit = error > 1e-5  # as in z_scores
    total = np.sum(opacity.mean(axis=-1)[hit] - exact[hit]) / np.sqrt(np.sum(error[hit] ** 2))
    return float(np.sqrt(np.mean(z[hit] ** 2))), float(total)


if __name__ == "__main__":
    main()
