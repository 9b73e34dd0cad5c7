"""How rays are sampled."""

from __future__ import annotations

from dataclasses import dataclass
from typing import get_args

from .rules import Rule


@dataclass(frozen=True)
class MarchSettings:
    """How rays are sampled."""

    samples: int = 128  # strata a ray
    fine: int = 0  # samples more, placed by the field's coarse network, if it has one
    near: float | None = None  # lower bound of t, in scene units; None: the box alone
    far: float | None = None  # upper bound of t
    rule: Rule = "constant"  # of quadrature
    stop: float = 0.0  # a ray ends where less than this share of light passes; 0: never
    hidden: float = 0.0  # optical depth by the occupancy's floor that hides a sample; 0: none
    block: int = 16384  # queries a network evaluation
    chunk: int = 1 << 21  # samples placed at a time in primal rendering

    def __post_init__(self) -> None:
        for name in ("samples", "block", "chunk"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name}={getattr(self, name)}, expected at least 1")
        for name in ("fine", "hidden"):
            if getattr(self, name) < 0:
                raise ValueError(f"{name}={getattr(self, name)}, expected 0 or more")
        if self.rule not in get_args(Rule):
            raise ValueError(f"rule='{self.rule}', expected {' or '.join(get_args(Rule))}")
        if not 0 <= self.stop < 1:
            raise ValueError(f"stop={self.stop}, expected 0 to less than 1")
        if self.near is not None and self.far is not None and not self.near < self.far:
            raise ValueError(f"near={self.near} must be smaller than far={self.far}")
