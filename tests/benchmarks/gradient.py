"""How exact gradients are.

    python -m tests.benchmarks.gradient

Compares the gradient that mi.render gives the weights of a small field with the one the
trainer computes for the same rays, and with central differences in float64; prints the
largest error relative to the gradient of the same tensor.
"""

from __future__ import annotations

import tempfile
from pathlib import Path

from tests.benchmarks import machine
from tests.plugins.test_gradients import difference_errors, gradient_setup, trainer_errors


def main() -> None:
    """Prints both figures."""
    print(machine())
    with tempfile.TemporaryDirectory() as folder:
        setup = gradient_setup(Path(folder))
        print(f"against the trainer: {max(trainer_errors(*setup).values()):.1e}")
        print(f"against float64 differences: {max(difference_errors(*setup).values()):.1e}")


if __name__ == "__main__":
    main()
