"""One training step, and the state that steps carry on."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import drjit as dr
import numpy as np

from ..base.errors import InputError
from ..base.kernel_stages import stage
from ..base.machine import available_memory
from ..base.tensor_file import prefixed
from ..data import Dataset
from ..fields.neural import NeuralField
from ..fields.protocol import Field
from ..march.marched import MarchedField
from ..march.occupancy import OccupancyGrid
from ..march.placing import place_samples, refine
from ..march.quadrature import Composite, integrate
from ..march.query import Evaluation
from ..march.render import render_rays
from ..march.samples import Samples, rays_with_samples
from ..march.settings import MarchSettings
from .batches import RayBatch, RaySource, blank_loss, step_rng
from .config import TrainConfig
from .growth import Reshaping, Snapshot, field_in_shape, reshaped
from .loss_scale import LossScale
from .losses import RayLoss
from .model import carved_cells, field_config
from .optimizer import Adam, JointParameters
from .scaling import resolved
from .schedule import grid_level_weights, image_level

_FEWEST_RAYS = 8  # in a step
_BYTES_PER_SAMPLE = 100  # parameter, width, density, colour, weight, and their adjoints
_COARSE_SEED = 500  # apart from the seeds of the fine network and of its restarts


@dataclass
class StepResult:
    """Device-side results of a step, each an array of one value."""

    loss: Any
    mse: Any
    accepted: Any
    rays: Any  # that counted
    queries: int


def _require_memory(config: TrainConfig) -> None:
    """Refuses steps whose samples alone would not fit in memory."""
    sampling = config.sampling
    samples = (sampling.rays or _FEWEST_RAYS) * (2 * sampling.samples + sampling.fine)
    needed = samples * _BYTES_PER_SAMPLE
    there = available_memory()
    if needed > there:
        raise InputError(
            f"sampling.samples={sampling.samples}, fine={sampling.fine}: one step would need "
            f"{needed / 2**30:.0f} GiB for its samples, expected less than {there / 2**30:.0f} GiB"
        )


@dataclass
class _Drawn:
    """The rays of a step, or some of them, and where in their strata samples lie."""

    batch: RayBatch
    jitter: Any  # of every ray's samples, in [0, 1)
    fine_jitter: Any  # of those that the coarse network places; none without

    @property
    def rays(self) -> int:
        """How many."""
        return self.batch.rays

    def part(self, start: int, rays: int) -> _Drawn:
        """``rays`` of the rays, from number ``start`` on."""

        def rows(values: Any) -> Any:
            count = len(values) // self.rays
            if rays == self.rays or not count:
                return values
            index = dr.arange(dr.uint32_array_t(type(values)), rays * count)
            return dr.gather(type(values), values, index + dr.opaque(type(index), start * count))

        return _Drawn(self.batch.part(start, rays), rows(self.jitter), rows(self.fine_jitter))


@dataclass
class _Part:
    """What some rays of a step came to; arrays hold one value each."""

    loss: Any  # their share of the step's
    mse: Any  # of the fine network, likewise
    rays: Any  # that counted
    queries: int  # made
    wanted: int  # queries that all of the rays would need

    def __add__(self, other: _Part) -> _Part:
        return _Part(
            self.loss + other.loss,
            self.mse + other.mse,
            self.rays + other.rays,
            self.queries + other.queries,
            self.wanted + other.wanted,
        )


class Trainer:
    """Holds a field, its optimiser and its occupancy, and improves them step by step."""

    def __init__(
        self,
        config: TrainConfig,
        dataset: Dataset,
        backend: Any,
        cells: np.ndarray[Any, Any] | None = None,
    ) -> None:
        """
        Args:
            backend: ``drjit.llvm.ad`` or ``drjit.cuda.ad``.
            cells: those that may hold something, (X, Y, Z) booleans; found if not given.
        """
        config = resolved(config, dataset)
        self.config, self._backend = config, backend
        self.field_config = field_config(config, dataset)
        self._hull = carved_cells(config, dataset, self.field_config) if cells is None else cells
        _require_memory(config)
        self.background = config.background
        if self.background == "auto":
            self.background = "random" if dataset.has_alpha else "white"
        self._noise_level = 0.0 if dataset.has_alpha else config.density.noise
        self._images = RaySource(dataset, self.background, backend.Float, config.pyramid)
        self.learn_from()
        loss = config.loss
        if loss == "auto":
            loss = "mse" if dataset.color_space == "srgb" else "relative"
        self._loss = RayLoss(loss, self.background, config.loss_floor)
        level = config.pyramid.levels or 0
        self.blank_loss = blank_loss(dataset, self.background, level, loss)
        self.step_count = 0
        self.attempt = 0  # restarts after a collapse so far
        self.rays_per_step = 0.0
        self.reset()

    def learn_from(self, views: Sequence[int] | None = None) -> None:
        """Takes the rays of further steps from these views of the dataset alone; none: all."""
        self._source = self._images if views is None else self._images.of_views(views)

    def pixels_of(self, views: Sequence[int], count: int, seed: int) -> RayBatch:
        """Random pixels of some views, those of the images themselves."""
        return self._images.of_views(views).draw(count, step_rng(self._backend.Float, seed, 0))

    def reset(self) -> None:
        """Fresh weights, moments and occupancy, from the seed and the attempt."""
        config = self.config
        seed = config.seed + 1000 * self.attempt
        tensors, coarse = self._backend.TensorXf, None
        if config.sampling.fine:
            coarse = NeuralField.create(self.field_config, seed + _COARSE_SEED, tensors)
        self._optimize(NeuralField.create(self.field_config, seed, tensors, coarse))
        self.loss_scale = LossScale(self._backend.Float) if config.half_precision else None
        self.occupancy = None
        if config.occupancy.enabled:
            self.occupancy = OccupancyGrid(
                self.field.lower, self.field.upper, self._hull, self._backend.Float
            )
        sampling = config.sampling
        self.rays_per_step = float(
            sampling.rays or min(sampling.max_rays, max(1, sampling.batch // sampling.samples))
        )

    def _optimize(self, field: NeuralField) -> None:
        """Begins to optimise the parameters of a field."""
        self.field = field
        groups = {"": field.parameters()}
        if field.coarse is not None:
            groups["coarse."] = field.coarse.parameters()
        self.parameters = JointParameters(groups)
        options = self.config.optimizer
        self.optimizer = Adam(
            self.parameters,
            beta1=options.beta1,
            beta2=options.beta2,
            epsilon=options.epsilon,
            muon=options.muon,
        )

    def become(self, config: TrainConfig) -> None:
        """Goes on with another configuration, from the present parameters and moments.

        A larger model is the same function at first; see :mod:`mi_nerf.training.growth`.
        Data, box, loss and precision stay as they are.

        Raises:
            ValueError: if layers would have to go, or could not start as the identity.
        """
        self.go_on_from(self.in_shape_of(config))

    def in_shape_of(self, config: TrainConfig) -> Snapshot:
        """The model that :meth:`become` would go on with; changes nothing."""
        return reshaped(self.snapshot(), config, self._shape_seed(), self._left(config))

    def field_in_shape_of(self, config: TrainConfig) -> NeuralField:
        """The field alone that :meth:`become` would go on with; changes nothing."""
        model = self.snapshot()
        field = field_in_shape(model.field, config)
        weights = Reshaping(model.field, field).weights(
            {n: w for n, w in model.weights.items() if not n.startswith("coarse.")},
            self._shape_seed(),
            importance=prefixed(model.optimizer, "second."),
            direction=self._left(config),
        )
        return NeuralField(field, weights, self._backend.TensorXf, self.field.coarse)

    def _shape_seed(self) -> int:
        return self.config.seed + 1000 * self.attempt + self.step_count

    def _left(self, config: TrainConfig) -> np.ndarray[Any, Any] | None:
        """What a field that is to see no directions any more sees in their place."""
        loses = self.config.network.view_dependent and not config.network.view_dependent
        return self._mean_direction() if loses else None

    def snapshot(self) -> Snapshot:
        """The model as it is now, for :meth:`go_on_from`."""
        return Snapshot(
            self.config,
            self.field_config,
            {name: np.array(tensor) for name, tensor in self.parameters.items()},
            self.optimizer.state(),
            self._hull,
            {} if self.occupancy is None else self.occupancy.state(),
            self.rays_per_step,
        )

    def go_on_from(self, model: Snapshot) -> None:
        """Takes up a model; the number of the step stays."""
        self.config, self.field_config, self._hull = model.config, model.field, model.cells
        tensors, coarse = self._backend.TensorXf, None
        if model.config.sampling.fine:
            coarse = NeuralField(model.field, prefixed(model.weights, "coarse."), tensors)
        own = {n: a for n, a in model.weights.items() if not n.startswith("coarse.")}
        self._optimize(NeuralField(model.field, own, tensors, coarse))
        self.optimizer.restore(model.optimizer)
        if self.occupancy is not None:
            self.occupancy = OccupancyGrid(
                self.field.lower, self.field.upper, model.cells, self._backend.Float
            )
            self.occupancy.restore(model.occupancy)
        self.rays_per_step = model.rays

    def _mean_direction(self) -> np.ndarray[Any, Any]:
        """Features of directions, their mean over rays of the images."""
        batch = self._source.draw(4096, step_rng(self._backend.Float, self.config.seed, 0))
        with dr.suspend_grad():
            features = self.field_config.direction.features(batch.d)
            return np.array([float(dr.mean(f)[0]) for f in features], np.float32)

    @property
    def image_bytes(self) -> int:
        """Memory that the pixels take on the device."""
        return self._images.nbytes

    def march_settings(self) -> MarchSettings:
        """How rays are sampled in training."""
        s = self.config.sampling
        return MarchSettings(
            samples=s.samples,
            near=s.near,
            far=s.far,
            rule=s.rule,
            hidden=s.hidden,
            block=min(s.block, s.batch),
        )

    def step(self, learning_rate: float, progress: float = 1.0) -> StepResult:
        """One optimisation step. Launches work; reads nothing back but sample counts.

        Args:
            progress: share of the run's budget that is spent: how sharp the images are.
        """
        self._weigh_levels(progress)
        drawn = self._draw(image_level(self.config.pyramid, progress))
        found = self._differentiate(drawn)
        accepted = self._update(learning_rate, found.loss)
        self._adapt_rays(drawn.rays, found.wanted)
        return StepResult(found.loss, found.mse, accepted, found.rays, found.queries)

    def validate(
        self, batch: RayBatch, field: Field | None = None, *, samples: int | None = None
    ) -> float:
        """The loss over the pixels of ``batch``, by this field or another; changes nothing.

        Args:
            samples: strata a ray; none: as in training.
        """
        march = replace(self.march_settings(), hidden=0.0, fine=self.config.sampling.fine)
        march = replace(march, samples=samples or march.samples)
        with dr.suspend_grad():
            seen = render_rays(
                MarchedField(field or self.field, march, self.occupancy), batch.o, batch.d
            )
            relative = self._loss.kind == "relative"
            measure = self._loss if relative else self._loss.before
            return float(dr.mean(measure(seen.color, seen.opacity, batch)[0])[0])

    # ---------------------------- The phases of a step ------------------------------

    def _draw(self, level: float = 0.0) -> _Drawn:
        """Random rays and offsets of their samples: they follow from seed, step and level."""
        config, float_type, rays = self.config, self._backend.Float, self._ray_count()
        rng = step_rng(float_type, config.seed, self.step_count)
        crop = config.crop if self.step_count < config.crop_steps else 1.0
        fine = config.sampling.fine
        with stage("rays"):
            batch = self._source.draw(rays, rng, crop, level)
            jitter = rng.random(float_type, rays * config.sampling.samples)
            fine_jitter = rng.random(float_type, rays * fine) if fine else float_type()
            dr.eval(jitter, fine_jitter)
        return _Drawn(batch, jitter, fine_jitter)

    def _differentiate(self, drawn: _Drawn) -> _Part:
        """Sets the gradients of all parameters to those of the loss, part by part."""
        self.optimizer.zero_grad()
        field = self._field_in_training()
        parts = [
            self._differentiate_part(field, drawn.part(start, size), size / drawn.rays)
            for start, size in self._parts(drawn.rays)
        ]
        return sum(parts[1:], parts[0])

    def _update(self, learning_rate: float, loss: Any) -> Any:
        """Moves the parameters, unless loss or gradients are not finite, and the occupancy.

        Returns:
            A mask of one element: whether the parameters moved.
        """
        with stage("optimizer"):
            accepted = self.optimizer.step(learning_rate, dr.isfinite(loss))
            if self.loss_scale is not None:
                self.loss_scale.update(accepted)
        self.step_count += 1
        with stage("occupancy"):
            self._refresh_occupancy()
        return accepted

    def _weigh_levels(self, progress: float) -> None:
        """Levels of the grid join as the images come to resolve them."""
        grid, pyramid = self.field_config.grid, self.config.pyramid
        if grid is None or not pyramid.features or not pyramid.levels:
            return
        weights = self._backend.Float(grid_level_weights(pyramid, grid, progress))
        self.field.level_weights = weights
        if self.field.coarse is not None:
            self.field.coarse.level_weights = weights

    # ------------------------------ Differentiation ---------------------------------

    def _parts(self, rays: int) -> Iterator[tuple[int, int]]:
        """Ranges of rays whose activations fit together in the memory set aside for them."""
        sampling, network = self.config.sampling, self.config.network
        units = self.field_config.position_size + self.config.direction.size
        units += network.depth * network.width + int(network.feature_layer) * network.width
        units += network.view_depth * network.view_width
        most = sampling.samples + bool(sampling.fine) * (sampling.samples + sampling.fine)
        needed = 4 * units * min(sampling.batch, rays * most)
        count = math.ceil(needed / (self.config.store_activations * 2**30))
        size = math.ceil(rays / min(count, rays))
        for start in range(0, rays, size):
            yield start, min(size, rays - start)

    def _field_in_training(self) -> NeuralField:
        """Noise on the densities of real captures (NeRF, appendix A), and half precision."""
        scale = None if self.loss_scale is None else self.loss_scale.value
        return self.field.for_training(self._noise_level, 2 * self.step_count, scale)

    def _differentiate_part(self, field: NeuralField, drawn: _Drawn, share: float) -> _Part:
        """Adds the gradients of the loss over ``share`` of the step's rays to the parameters'."""
        sampling, batch, march = self.config.sampling, drawn.batch, self.march_settings()
        budget = math.ceil(sampling.batch * share)
        with stage("samples"):
            marched = MarchedField(field, march, self.occupancy)
            samples = place_samples(marched, batch.o, batch.d, jitter=drawn.jitter)
        wanted = samples.queries
        complete = samples.truncate(budget)
        numbers = None
        if field.coarse is None and samples.queries:
            with stage("samples"):
                samples, numbers = rays_with_samples(samples)
        queries, passes = samples.queries, []
        if field.coarse is not None:
            coarse = self._evaluate(field.coarse, samples)
            with stage("compositing"):
                passes.append((coarse, integrate(coarse, samples)))
            weights, fine, offsets = passes[0][1].weights, sampling.fine, drawn.fine_jitter
            with stage("samples"):
                samples = refine(samples, weights, fine, self.occupancy, offsets, march.hidden)
            wanted += samples.queries
            complete = dr.minimum(complete, samples.truncate(max(1, budget - queries)))
            queries += samples.queries
        evaluation = self._evaluate(field, samples)
        with stage("compositing"):
            passes.append((evaluation, integrate(evaluation, samples)))
            errors = [self._errors(batch, seen, complete, share, numbers) for _, seen in passes]
            loss = sum((e for e, _ in errors), self._backend.Float(0))  # NeRF Eq. 6: of both
            dr.backward(loss)
            loss, mse = dr.detach(loss), errors[-1][1]
            dr.eval(loss, mse, complete)
        with stage("network"):
            for evaluation, _ in passes:
                evaluation.backward()
        formed = self.step_count >= self.config.occupancy.start
        if self.occupancy is not None and march.hidden > 0 and formed:
            with stage("occupancy"):
                self.occupancy.witness(samples, evaluation.density)
        return _Part(loss, mse, complete, queries, wanted)

    def _evaluate(self, field: NeuralField, samples: Samples) -> Evaluation:
        """With two networks, each evaluates its share of the batch, filled up but little."""
        sampling, block = self.config.sampling, self.march_settings().block
        if sampling.fine:
            both = 2 * sampling.samples + sampling.fine
            block = min(block, math.ceil(sampling.batch * samples.count / both))
        tail = math.ceil(block / 4) if sampling.fine else block
        with stage("network"):
            evaluation = Evaluation(field, samples, block, keep=True, tail=tail)
        evaluation.enable_grad()
        return evaluation

    def _errors(
        self, batch: RayBatch, seen: Composite, complete: Any, share: float, numbers: Any
    ) -> tuple[Any, Any]:
        """Loss and squared error of one network's image: ``share`` of the first rays' means.

        Args:
            numbers: of the rays that ``seen`` has; the others saw nothing. None: it has all.
        """
        float_type, uint = self._backend.Float, self._backend.UInt32
        weight = dr.opaque(float_type, share) / float_type(dr.maximum(complete, 1))
        number = dr.arange(uint, batch.rays)
        counts = number < complete
        loss, mse = float_type(0), float_type(0)
        if numbers is not None:
            zero = float_type(0)
            nothing = self._loss([zero, zero, zero], zero, batch)
            blank = dr.full(dr.mask_t(float_type), True, batch.rays)
            dr.make_opaque(blank)
            dr.scatter(blank, False, numbers)
            loss, mse = (dr.sum(dr.select(counts & blank, e, 0)) * weight for e in nothing)
            batch, counts = batch.at(numbers), numbers < complete
        errors = self._loss(seen.color, seen.opacity, batch)
        loss = loss + dr.sum(dr.select(counts, errors[0], 0)) * weight
        mse = mse + dr.sum(dr.select(counts, dr.detach(errors[1]), 0)) * weight
        return loss, mse

    def _ray_count(self) -> int:
        """Rays of the next step, in coarse steps so that arrays are seldom resized."""
        if self.config.sampling.rays is not None:
            return self.config.sampling.rays
        step = 64 if self.rays_per_step >= 512 else _FEWEST_RAYS
        return max(_FEWEST_RAYS, int(self.rays_per_step) // step * step)

    def _adapt_rays(self, rays: int, queries: int) -> None:
        """Aims at a full batch: more rays as space turns out to be empty."""
        sampling = self.config.sampling
        wanted = 0.95 * sampling.batch * rays / max(queries, 1)
        wanted = min(max(wanted, float(_FEWEST_RAYS)), float(sampling.max_rays))
        self.rays_per_step += 0.1 * (wanted - self.rays_per_step)

    def _refresh_occupancy(self) -> None:
        options = self.config.occupancy
        due = self.step_count >= options.start and self.step_count % options.every == 0
        if self.occupancy is not None and due:
            rng = step_rng(self._backend.Float, self.config.seed + (1 << 20), self.step_count)
            self.occupancy.refresh(
                self.field,
                rng,
                self.step_count // options.every,
                queries=options.queries,
                threshold=options.threshold,
                decay=options.decay,
            )
