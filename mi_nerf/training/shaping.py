"""How a model of preset ``auto`` takes shape while it trains.

It begins as that of preset ``fast``, and views are held back. Now and then they are asked what
they would lose, at once, if half of the entries of every level of the hash grid were taken out,
and at last, when colours are known, directions. What they would miss little goes, in place (see
:mod:`mi_nerf.training.growth`), and training goes on; a smaller model makes up for most of what
it loses at once. Comparisons are of the same weights, so that chance has no part in them.

Octaves of Fourier features are added instead, two at a time, as long as the field would miss the
last ones: it cannot do without those that it has begun with.

All views are learnt from after :data:`SETTLED` of the budget at the latest. At the end the field
says how many strata a ray needs when it is seen.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

from ..data import Dataset
from .auto import Decision, is_open, record
from .config import TrainConfig, with_settings
from .held_back import HeldBack
from .plain import as_text
from .trainer import Trainer

TOLERANCE = 0.1  # dB: what brings less is not kept
NEGLIGIBLE = 0.02  # dB: what costs less is taken out at the end
# dB with light averaged over directions. Of 400 steps on 200×200 pixels: a diffuse scene lost
# 0.0 and 0.14 dB, a glossy one 0.35 and 0.45 dB.
MOST_LOST = 0.2
MOST_CHANGED = 1.0  # dB that the mean of directions in their place may cost at once
# dB that smaller tables may cost each time before they have learnt. Of L dB lost so after 30 % of
# the steps, 0.02 L² to 0.06 L² were left at the end: Lego (100×100, 900 steps) 0.72 and 2.1 dB,
# 0.03 and 0.20 at the end; arches (600 steps) 1.9 and 3.3 dB, 0.08 and 0.20.
AT_ONCE = 0.6
ASKED = (0.2, 0.3, 0.4, 0.5)  # shares of the budget after which views held back are asked,
ASKED_STEPS = 200  # no earlier than after so many steps,
APART = 50  # nor sooner than so many after the last time
TRIAL = 0.03  # share of the budget for which something new is trained before it is judged,
TRIAL_STEPS = 60  # and no fewer steps than that
SETTLED = 0.6  # share of the budget after which nothing changes
LAST = 0.96  # share of the budget after which strata are counted
_FAR = 2  # times as much lost, and nobody asks again
_FEWEST_ENTRIES = 10  # log2 of those of a level
_OCTAVES, _MOST_OCTAVES = 2, 12  # added at a time; and in all

_DIRECTIONS, _ENTRIES = "network.view_dependent", "grid.log2_entries"
_L, _STRATA = "position.frequencies", "sampling.render_samples"


class Shaping:
    """Decides, step by step, how the model of a trainer goes on."""

    def __init__(
        self,
        trainer: Trainer,
        dataset: Dataset,
        decisions: list[Decision],
        progress: Callable[[], float],
    ) -> None:
        """
        Args:
            dataset: what the trainer learns from; views of it are held back at first.
            decisions: what has been decided so far; kept up to date.
            progress: the share of the budget that is spent.
        """
        self._trainer, self._decisions, self._progress = trainer, decisions, progress
        self._attempt = trainer.attempt
        self._held = HeldBack(dataset, trainer)
        if self._asks() and progress() < SETTLED:
            self._held.hold()
        self._policy = self._decide()

    def after_step(self) -> bool:
        """Takes note of a step; whether configuration or decisions have changed since."""
        if self._trainer.attempt != self._attempt:  # fresh weights have nothing to answer yet
            self._attempt = self._trainer.attempt
            self._policy = self._decide()
        before, config = list(self._decisions), self._trainer.config
        next(self._policy, None)
        return before != self._decisions or config != self._trainer.config

    def _asks(self) -> bool:
        return any(is_open(self._decisions, name) for name in (_DIRECTIONS, _ENTRIES, _L))

    # ---- The order of questions ----------------------------------------------------

    def _decide(self) -> Iterator[None]:
        """Advanced once after every step."""
        held = self._held
        if held.holds:
            yield from self._octaves(held)
            earliest = ASKED_STEPS
            for share in self._shares():
                yield from self._until(share, earliest)
                if self._progress() < SETTLED:
                    self._take_out(held, last=share == ASKED[-1])
                earliest = self._trainer.step_count + APART
            self._close()
            held.give_back()
            yield
        while self._progress() < LAST:
            yield
        self._strata(held)

    def _shares(self) -> list[float]:
        """When to ask: not of a field that has only seen coarser images what it would miss."""
        pyramid = self._trainer.config.pyramid
        return [share for share in ASKED if not pyramid.levels or share > pyramid.until]

    def _until(self, share: float, step: int) -> Iterator[None]:
        """Trains until a share of the budget is spent and a step is reached, as far as it may."""
        while self._progress() < share or self._trainer.step_count < step:
            if self._progress() >= SETTLED:
                return
            yield

    def _close(self) -> None:
        """What could not be asked stays as it is."""
        for decision in list(self._decisions):
            if decision.open and decision.setting in (_DIRECTIONS, _ENTRIES, _L):
                why = f"{decision.reason}; too few steps to ask what else"
                self._say(decision.setting, decision.value, why)

    def _say(self, setting: str, value: Any, reason: str, *, still: bool = False) -> None:
        record(self._decisions, Decision(setting, value, reason, still))

    def _with(self, settings: dict[str, Any]) -> TrainConfig:
        assignments = [f"{name}={as_text(value)}" for name, value in settings.items()]
        return with_settings(self._trainer.config, assignments)

    # ---- The questions --------------------------------------------------------------

    def _take_out(self, held: HeldBack, last: bool) -> None:
        """Directions and entries that are not missed."""
        found: dict[str, Any] = {}
        lost = self._directions(held, found) if last else 0.0
        self._entries(held, found, lost, last)
        if found:
            self._trainer.become(self._with(found))

    def _directions(self, held: HeldBack, found: dict[str, Any]) -> float:
        """They go if light is even; returns what their mean in their place costs at once, dB."""
        if not is_open(self._decisions, _DIRECTIONS):
            return 0.0
        mean, even = held.lost_as(self._with({_DIRECTIONS: False})), None
        why = f"after {self._trainer.step_count} steps views held back would lose {mean:.2f} dB, "
        why += "at once, with the mean of directions in their place"
        if mean <= MOST_CHANGED:
            even = held.lost_even()
            why += f", and {even:.2f} with light averaged over them"
        if even is None or not even <= MOST_LOST:
            self._say(_DIRECTIONS, True, why)
            return 0.0
        found[_DIRECTIONS] = False
        self._say(_DIRECTIONS, False, f"taken out: {why}")
        return mean

    def _entries(
        self, held: HeldBack, found: dict[str, Any], lost_before: float, last: bool
    ) -> None:
        """Halved as long as that loses little at once, besides what goes anyway."""
        grid = self._trainer.config.grid
        if grid is None or not is_open(self._decisions, _ENTRIES):
            return
        entries, said, lost = grid.most_entries.bit_length() - 1, [], 0.0
        for fewer in range(entries - 1, _FEWEST_ENTRIES - 1, -1):
            lost = held.lost_as(self._with({**found, _ENTRIES: fewer})) - lost_before
            said.append(f"{lost:.2f} dB with 2^{fewer}")
            if not lost <= AT_ONCE:  # NaN, too
                break
            found[_ENTRIES] = entries = fewer
        why = f"after {self._trainer.step_count} steps {', '.join(said)}"
        earlier = next(d.reason for d in self._decisions if d.setting == _ENTRIES)
        first = "views held back would lose, at once,"
        why = f"{earlier}; {why}" if earlier.startswith(first) else f"{first} {why}"
        more = lost <= _FAR * AT_ONCE and entries > _FEWEST_ENTRIES
        self._say(_ENTRIES, entries, why, still=more and not last)

    def _octaves(self, held: HeldBack) -> Iterator[None]:
        """Two more, as long as the field would miss the last ones."""
        if self._trainer.config.grid is not None or not is_open(self._decisions, _L):
            return
        octaves, said = self._trainer.field_config.position.frequencies, []
        while octaves + _OCTAVES <= _MOST_OCTAVES:
            octaves += _OCTAVES
            self._trainer.become(self._with({_L: octaves}))
            start, step = self._progress(), self._trainer.step_count
            yield from self._until(start + TRIAL, step + TRIAL_STEPS)
            if self._progress() >= SETTLED:
                said.append("no time for more")
                break
            lost = held.lost_as(self._with({_L: octaves - _OCTAVES}))
            said.append(f"L = {octaves} without the last {_OCTAVES} would lose {lost:.2f} dB")
            if lost < TOLERANCE:
                octaves -= _OCTAVES
                self._trainer.become(self._with({_L: octaves}))
                break
        self._say(_L, octaves, f"more from few octaves on; {'; '.join(said)}")

    def _strata(self, held: HeldBack) -> None:
        """As few strata a ray as the field can be seen with, now that it is almost finished."""
        usual = self._trainer.config.sampling.render_samples
        if not is_open(self._decisions, _STRATA):
            return
        found = {usual: held.quality(samples=usual)}
        for count in (3 * usual // 2, usual // 2, 3 * usual // 4):
            if count != 3 * usual // 4 or usual // 2 not in _enough(found, usual):
                found[count] = held.quality(samples=count)
        chosen = min(_enough(found, usual))
        said = ", ".join(f"{q:.2f} dB with {n}" for n, q in sorted(found.items()))
        self._say(_STRATA, chosen, said)
        if chosen != usual:
            self._trainer.become(self._with({_STRATA: chosen}))


def _enough(found: dict[int, float], usual: int) -> list[int]:
    """Numbers of strata that lose next to nothing; more than usual only if they bring much."""
    worth = {n: q - (TOLERANCE if n > usual else 0) for n, q in found.items()}
    return [n for n, q in worth.items() if q >= max(worth.values()) - NEGLIGIBLE]
