"""Which of several points no other one beats."""

from __future__ import annotations

from collections.abc import Sequence


def pareto_front(costs: Sequence[float], errors: Sequence[float]) -> list[bool]:
    """Marks the points for which no other is as cheap and as exact, and better in one of both.

    Equal points are marked alike. NaN in either number leaves a point out.

    >>> pareto_front([1, 2, 3, 3], [0.5, 0.2, 0.3, 0.1])
    [True, True, False, True]
    """
    usable = [i for i, pair in enumerate(zip(costs, errors, strict=True)) if _known(*pair)]
    marked = [False] * len(costs)
    best = float("inf")  # least error among cheaper points
    cost_of_best = float("-inf")
    for i in sorted(usable, key=lambda i: (costs[i], errors[i])):
        if errors[i] < best:
            best, cost_of_best = errors[i], costs[i]
        marked[i] = errors[i] == best and costs[i] == cost_of_best
    return marked


def _known(*values: float) -> bool:
    return all(v == v for v in values)
