"""Which stage of a training step launches which kernel.

Kernels carry no names, and Dr.Jit launches them later than they are traced: when a matrix
product, a compaction or an explicit evaluation needs their results. So the engine marks
its stages, and a kernel belongs to the innermost stage that is open *when it is launched*:

    with stage("encoding"):
        features = settled(encoding(p))

Unless somebody records, both cost a look at a variable and change nothing. While somebody
does, :func:`settled` evaluates what the next matrix product would evaluate anyway, and
each boundary waits for the kernels launched so far. The kernels stay the same.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import dataclass, field
from typing import Any, Literal, TypeVar

import drjit as dr

HOST = "Host"  # the type of a launch that was none: work of the calling thread

T = TypeVar("T")

Stage = Literal[
    "rays",  # pixels chosen, their rays, random numbers
    "samples",  # placed, looked up in the occupancy grid, compacted, cut into blocks
    "encoding",  # rays gathered for the queries, features of positions and directions
    "network",  # everything else that a field does, forward and backward
    "scatter",  # activations of density and colour, scattered to the samples
    "compositing",  # quadrature and loss, and their adjoints
    "encoding_adjoint",  # into hash grids; gradients of several blocks added up
    "optimizer",
    "occupancy",  # refresh of the grid, its queries of the field included
]


@dataclass(frozen=True)
class Launch:
    """One kernel, or another operation of Dr.Jit on the device."""

    stages: tuple[Stage, ...]  # open at its launch, from the outside in
    type: Any  # drjit.KernelType, or HOST
    size: int  # number of threads
    code: str  # hash of a just-in-time compiled kernel; else empty
    milliseconds: float  # on the device
    compiled: bool  # it was not yet in memory


@dataclass
class Recorder:
    """What was launched while it was active."""

    launches: list[Launch] = field(default_factory=list)
    _open: list[Stage] = field(default_factory=list)

    def collect(self) -> None:
        """Waits for the kernels launched since the last call; they are of the open stages."""
        stages = tuple(self._open)
        for entry in dr.kernel_history():
            launch = Launch(
                stages,
                entry["type"],
                entry["size"],
                str(entry.get("hash", "")),
                entry["execution_time"],
                entry.get("cache_hit", True) == 0,
            )
            self.launches.append(launch)

    @contextmanager
    def stage(self, name: Stage) -> Iterator[None]:
        """Kernels launched inside are of this stage."""
        self.collect()
        self._open.append(name)
        try:
            yield
        finally:
            self.collect()
            self._open.pop()


_recorder: Recorder | None = None


def stage(name: Stage) -> AbstractContextManager[None]:
    """Marks a stage; without a recorder, nothing."""
    return nullcontext() if _recorder is None else _recorder.stage(name)


def settled(value: T) -> T:
    """``value``, evaluated if somebody records, so that it counts in the open stage."""
    if _recorder is not None:
        dr.eval(value)
    return value


@contextmanager
def host_work(size: int) -> Iterator[None]:
    """What happens inside is no kernel, but work on ``size`` entries that counts as one."""
    if _recorder is None:
        yield
        return
    _recorder.collect()
    begin = time.perf_counter()
    yield
    elapsed = 1e3 * (time.perf_counter() - begin)
    _recorder.launches.append(Launch(tuple(_recorder._open), HOST, size, "", elapsed, False))


@contextmanager
def recording(marked: bool = True) -> Iterator[Recorder]:
    """Records all launches of the block; without ``marked``, of no stage and in one piece."""
    global _recorder
    recorder, before = Recorder(), _recorder
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        dr.kernel_history_clear()
        _recorder = recorder if marked else None
        try:
            yield recorder
            recorder.collect()
        finally:
            _recorder = before
