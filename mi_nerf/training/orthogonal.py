"""Updates of matrices with singular values of about one (Muon, Jordan et al. 2024)."""

from __future__ import annotations

from typing import Any

import drjit as dr

# Of an odd polynomial that takes singular values in (0, 1] to about one in a few rounds.
_A, _B, _C = 3.4445, -4.7750, 2.0315
_ROUNDS = 5
_FEWEST = 32  # rows and columns; a matrix thinner than that is left to Adam


def is_hidden(shape: tuple[int, ...]) -> bool:
    """Whether a parameter is a matrix between layers of many neurons."""
    return len(shape) == 2 and min(shape) >= _FEWEST


def orthogonalized(matrix: Any) -> Any:
    """About U Vᵀ of an (N, M) tensor U Σ Vᵀ, by Newton–Schulz iteration.

    Singular values from 0.01 of the norm on end between 0.6 and 1.3; smaller ones grow by
    a factor of up to 3.4 a round. Zeros stay zeros.
    """
    tall = matrix.shape[0] > matrix.shape[1]
    x = matrix.T if tall else matrix
    x = x / (dr.sqrt(dr.sum(dr.square(x), axis=None)) + 1e-12)
    for _ in range(_ROUNDS):
        gram = x @ x.T
        dr.eval(gram)
        mix = _B * gram + _C * (gram @ gram)
        dr.eval(mix)
        x = _A * x + mix @ x
        dr.eval(x)
    return x.T if tall else x


def update_size(shape: tuple[int, ...]) -> float:
    """By what an orthogonal matrix is multiplied to be as large as a step of Adam.

    Its entries have a root mean square of 1/√max(N, M); 0.2 is usual of Adam's (Liu et
    al. 2025).
    """
    return 0.2 * float(max(shape)) ** 0.5
