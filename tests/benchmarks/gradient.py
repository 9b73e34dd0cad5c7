"""How exact gradients are.

    python -m tests.benchmarks.gradient

Compares the gradient that mi.render gives the weights of a small field with the one the
trainer computes for the same rays, and with central differences in float64; prints the
largest error relative to the gradient of the same tensor.
"""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path

from mi_nerf.base.variants import choose_variant
from tests.benchmarks import machine
from tests.benchmarks.results import RENDERING, TRAINING, Figure, Row, add_options, save
from tests.plugins.test_gradients import difference_errors, gradient_setup, trainer_errors


def main() -> None:
    """Prints both figures."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    add_options(parser)
    options = parser.parse_args()
    print(machine())
    with tempfile.TemporaryDirectory() as folder:
        setup = gradient_setup(Path(folder))
        errors = {
            "the trainer's": max(trainer_errors(*setup).values()),
            "float64 differences": max(difference_errors(*setup).values()),
        }
    for name, error in errors.items():
        print(f"against {name}: {error:.1e}")
    figures = {f"against {name}": Figure(error) for name, error in errors.items()}
    row = Row({"what": "relative error of the gradient of mi.render"}, figures)
    parts = tuple(sorted({*TRAINING, *RENDERING}))
    save("gradient", [row], options, choose_variant(), parts)


if __name__ == "__main__":
    main()
