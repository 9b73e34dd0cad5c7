"""How a model of preset ``auto`` grows while it trains, and where it stops.

Views are held back from the beginning. Again and again one thing is added in place (it is
the same function at first, see :mod:`mi_nerf.training.growth`), trained for a share of the
budget, and judged on these views:

- directions: needed if light averaged over directions would be worse, after many steps;
- entries of the hash grid, doubled, or octaves of Fourier features: needed if the field as
  it would be without them is worse; else they go at once;
- a second layer: needed if it brings more than the smaller network would have learnt in the
  same time; else training goes on from where it was added.

Growth ends at the latest after :data:`GROWN` of the budget. All views are learnt from then
on. At the end the field says how many strata a ray needs when it is seen.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from typing import Any

from ..data import Dataset
from .auto import SMALLER_TABLE, Decision, may_grow, record
from .config import with_settings
from .held_back import HeldBack
from .model import resolved_octaves
from .plain import as_text
from .trainer import Trainer

TOLERANCE = 0.1  # dB: what brings less is not kept
NEGLIGIBLE = 0.02  # dB: what costs less is taken out at the end
# Of 400 steps on 200×200 pixels: a diffuse scene lost 0.0 and 0.14 dB, a glossy one 0.35
# and 0.45 dB. After 60 steps this says nothing yet (kettle: 0.10 dB, and 1.8 dB at the end).
MOST_LOST = 0.2  # dB that light averaged over directions may lose
SEEN_STEPS = 400  # with directions before that is asked
FIRST = 0.03  # share of the budget after which the model grows for the first time,
FIRST_STEPS = 100  # and no earlier than after so many steps
TRIAL = 0.03  # share of the budget for which something new is trained before it is judged,
TRIAL_STEPS = 60  # and no fewer steps than that
GROWN = 0.4  # share of the budget after which nothing is added
LAST = 0.96  # share of the budget after which strata are counted
_DEEPER_STEPS = 4000  # steps that a run must have time for to try another layer
_OCTAVES = 2  # added at a time
# dB that halving a table may lose right after it was doubled, when its entries have only begun
# to part. Lego (100×100, 900 steps): 0.03 dB at 2^16 entries after 60 steps, and 0.36 dB behind
# preset fast at the end with 2^15.
_HALVED = NEGLIGIBLE
_PACED = (5, 15)  # steps that wait for the compiler, and that show what a step takes


class Growing:
    """Decides, step by step, how the model of a trainer goes on."""

    def __init__(
        self,
        trainer: Trainer,
        dataset: Dataset,
        decisions: list[Decision],
        progress: Callable[[], float],
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        """
        Args:
            dataset: what the trainer learns from; views of it are held back at first.
            decisions: what has been decided so far; kept up to date.
            progress: the share of the budget that is spent.
            clock: seconds, by which steps are timed.
        """
        self._trainer, self._dataset, self._decisions = trainer, dataset, decisions
        self._progress, self._clock = progress, clock
        self._pace = 0.0  # a step's share of the budget
        self._attempt = trainer.attempt
        self._sighted: int | None = None  # the step at which directions were added
        self._held = HeldBack(dataset, trainer)
        if self._asks() and progress() < GROWN:
            self._held.hold()
        self._policy = self._decide()

    def after_step(self) -> bool:
        """Takes note of a step; whether configuration or decisions have changed since."""
        if self._trainer.attempt != self._attempt:  # fresh weights: a trial has no meaning now
            self._attempt = self._trainer.attempt
            self._policy = self._decide()
        before, config = list(self._decisions), self._trainer.config
        next(self._policy, None)
        return before != self._decisions or config != self._trainer.config

    def _asks(self) -> bool:
        names = ("network.view_dependent", "grid.log2_entries", "position.frequencies")
        return any(may_grow(self._decisions, n) for n in (*names, "network.depth"))

    # ---- The order of questions ----------------------------------------------------

    def _decide(self) -> Iterator[None]:
        """Advanced once after every step."""
        held = self._held
        if held.holds:
            yield from self._time_steps()
            if self._progress() + self._pace * (FIRST_STEPS + 2 * TRIAL_STEPS) > GROWN:
                self._hurry()
            else:
                yield from self._pass(FIRST, FIRST_STEPS - sum(_PACED))
                questions = (
                    self._directions,
                    self._entries,
                    self._octaves,
                    self._sight,
                    self._depth,
                )
                for ask in questions:
                    yield from ask(held)
            held.give_back()
            yield
        while self._progress() < LAST:
            yield
        self._strata(held)

    def _pass(self, share: float, steps: int) -> Iterator[None]:
        """Trains for a share of the budget, and for so many steps at least."""
        start, first = self._progress(), self._trainer.step_count
        while self._progress() < start + share or self._trainer.step_count < first + steps:
            yield

    def _time_steps(self) -> Iterator[None]:
        """Takes a few steps; the first ones are left out, which wait for the compiler."""
        yield from self._pass(0, _PACED[0])
        before = self._progress()
        yield from self._pass(0, _PACED[1])
        self._pace = (self._progress() - before) / _PACED[1]

    def _time_left(self, trials: int = 1) -> bool:
        """Whether so many trials would end before growth has to."""
        return self._progress() + trials * max(TRIAL, TRIAL_STEPS * self._pace) <= GROWN

    def _hurry(self) -> None:
        """The sizes of preset ``fast``, at once."""
        config, why = self._trainer.config, "as in preset fast: too few steps to ask what else"
        usual = {"network.view_dependent": True, "network.view_depth": 1, "network.depth": 1}
        if config.grid is not None:
            usual["grid.log2_entries"] = config.grid.log2_entries + SMALLER_TABLE
        else:
            field = self._trainer.field_config
            octaves = resolved_octaves(self._dataset, field.lower, field.upper)
            usual["position.frequencies"] = octaves
        open_now = {n: v for n, v in usual.items() if may_grow(self._decisions, n)}
        if "network.view_dependent" not in open_now:
            open_now.pop("network.view_depth", None)
        self._become(*(f"{name}={as_text(value)}" for name, value in open_now.items()))
        for name, value in open_now.items():
            self._say(name, value, why)

    def _say(self, setting: str, value: Any, reason: str) -> None:
        record(self._decisions, Decision(setting, value, reason))

    def _become(self, *settings: str) -> None:
        self._trainer.become(with_settings(self._trainer.config, list(settings)))

    # ---- The questions --------------------------------------------------------------

    def _directions(self, held: HeldBack) -> Iterator[None]:
        """Added, and taken out again if their mean would do."""
        name, trainer = "network.view_dependent", self._trainer
        if not may_grow(self._decisions, name):
            return
        if trainer.config.network.view_dependent:
            self._say(name, True, "added before training began again")
            return
        self._sighted, quality = trainer.step_count, held.quality()
        self._become(f"{name}=true", "network.view_depth=1")
        yield from self._pass(TRIAL, TRIAL_STEPS)
        why = (
            f"added: views held back had {quality:.2f} dB without them, {held.quality():.2f} "
            f"{trainer.step_count - self._sighted} steps later"
        )
        self._say(name, True, why)
        self._say("network.view_depth", 1, "directions are seen by a layer of their own")

    def _sight(self, held: HeldBack) -> Iterator[None]:
        """Directions are taken out if their mean would do, once that can be told."""
        name, trainer = "network.view_dependent", self._trainer
        if self._sighted is None:
            return
        while trainer.step_count < self._sighted + SEEN_STEPS:
            if self._progress() >= GROWN:
                return
            yield
        blind = with_settings(trainer.config, [f"{name}=false"])
        even, mean = held.lost_even(), held.lost_as(blind)
        why = (
            f"light averaged over directions would lose {even:.2f} dB, their mean {mean:.2f}, "
            f"{trainer.step_count - self._sighted} steps after they were added"
        )
        needless = max(even, mean) <= MOST_LOST
        self._say(name, not needless, f"{'taken out again' if needless else 'added'}: {why}")
        if needless:
            trainer.become(blind)

    def _entries(self, held: HeldBack) -> Iterator[None]:
        """Doubled as long as halving them again would cost something."""
        name, grid = "grid.log2_entries", self._trainer.config.grid
        if grid is None or not may_grow(self._decisions, name):
            return
        entries, most, said = grid.log2_entries, grid.log2_entries + SMALLER_TABLE, ""
        while entries < most and self._time_left():
            entries += 1
            self._become(f"{name}={entries}")
            yield from self._pass(TRIAL, TRIAL_STEPS)
            lost = self._lost(held, f"{name}={entries - 1}")
            said += f"; 2^{entries} halved again would lose {lost:.2f} dB"
            if lost < _HALVED:
                entries -= 1
                self._become(f"{name}={entries}")
                break
        ended = "doubled from small tables on" if said else "no time to double them"
        self._say(name, entries, f"{ended}{said}")

    def _octaves(self, held: HeldBack) -> Iterator[None]:
        """Two more, as long as the field would miss the last ones."""
        name, config = "position.frequencies", self._trainer.config
        if config.grid is not None or not may_grow(self._decisions, name):
            return
        octaves, said = self._trainer.field_config.position.frequencies, ""
        while octaves + _OCTAVES <= 12 and self._time_left():
            octaves += _OCTAVES
            self._become(f"{name}={octaves}")
            yield from self._pass(TRIAL, TRIAL_STEPS)
            lost = self._lost(held, f"{name}={octaves - _OCTAVES}")
            said += f"; L = {octaves} without the last {_OCTAVES} would lose {lost:.2f} dB"
            if lost < TOLERANCE:
                octaves -= _OCTAVES
                self._become(f"{name}={octaves}")
                break
        ended = "more from few octaves on" if said else "no time for more octaves"
        self._say(name, octaves, f"{ended}{said}")

    def _depth(self, held: HeldBack) -> Iterator[None]:
        """A second layer, if it gains more than the one would in the same time."""
        name, trainer = "network.depth", self._trainer
        if not may_grow(self._decisions, name) or trainer.config.network.depth != 1:
            return
        if _DEEPER_STEPS * self._pace > 1 or not self._time_left(2):
            self._say(name, 1, "as in preset fast: no time for a trial of a second layer")
            return
        earlier, start = held.quality(), self._clock()
        yield from self._pass(TRIAL, TRIAL_STEPS)
        before, quality, between = trainer.snapshot(), held.quality(), self._clock()
        self._become(f"{name}=2")
        yield from self._pass(TRIAL, TRIAL_STEPS)
        gain, slope = held.quality() - quality, max(0.0, quality - earlier)
        # In the time that this took, the smaller network would have gained no more than before.
        rivals = slope * (self._clock() - between) / max(between - start, 1e-9)
        why = f"a second layer gained {gain:.2f} dB, where one had gained {slope:.2f} just before"
        if gain > rivals + TOLERANCE:
            self._say(name, 2, f"added: {why}")
            return
        trainer.go_on_from(before)
        self._say(name, 1, f"added and taken out again: {why}")

    def _strata(self, held: HeldBack) -> None:
        """As few strata a ray as the field can be seen with, now that it is almost finished."""
        name, usual = "sampling.render_samples", self._trainer.config.sampling.render_samples
        if not may_grow(self._decisions, name):
            return
        found = {usual: held.quality(samples=usual)}
        for count in (3 * usual // 2, usual // 2, 3 * usual // 4):
            if count != 3 * usual // 4 or usual // 2 not in self._enough(found, usual):
                found[count] = held.quality(samples=count)
        chosen = min(self._enough(found, usual))
        said = ", ".join(f"{q:.2f} dB with {n}" for n, q in sorted(found.items()))
        self._say(name, chosen, said)
        if chosen != usual:
            self._become(f"{name}={chosen}")

    @staticmethod
    def _enough(found: dict[int, float], usual: int) -> list[int]:
        """Numbers of strata that lose next to nothing; more than usual only if they bring much."""
        worth = {n: q - (TOLERANCE if n > usual else 0) for n, q in found.items()}
        return [n for n, q in worth.items() if q >= max(worth.values()) - NEGLIGIBLE]

    def _lost(self, held: HeldBack, setting: str) -> float:
        return held.lost_as(with_settings(self._trainer.config, [setting]))
