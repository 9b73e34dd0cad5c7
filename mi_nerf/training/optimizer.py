"""Adam (Kingma & Ba 2015) that can decline a step and whose state can be saved.

Matrices between hidden layers may be updated by Muon instead, from the same first moment.

Dr.Jit's own optimizer would serve, but a step with a non-finite gradient must leave
parameters *and* moments untouched, without the host waiting to find out. So the
decision is taken on the device.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, MutableMapping
from typing import Any

import drjit as dr
import numpy as np

from ..base.arrays import upload
from ..fields.network import GRID
from .orthogonal import is_hidden, orthogonalized, update_size


def _choose(mask: Any, a: Any, b: Any) -> Any:
    """A tensor of the entries of ``a`` where the flat ``mask`` holds, else of ``b``."""
    return type(a)(dr.select(mask, a.array, b.array), shape=b.shape)


def _finite_squares(gradients: Iterable[Any]) -> Any:
    """A mask of one element: whether the square of every entry is a number of single precision.

    Each gradient is read once and nothing of its size written, as a sum of squares would: only
    entries that fail are scattered, all to one place.
    """
    failed, kept = None, list(gradients)
    dr.eval(kept)
    for g in kept:
        flat = g.array
        uint = dr.uint32_array_t(type(flat))
        if failed is None:
            failed = dr.zeros(uint, 1)
        dr.scatter(failed, uint(1), uint(0), ~dr.isfinite(dr.square(flat)))
    return failed == 0


class JointParameters(MutableMapping[str, Any]):
    """Several dictionaries of tensors as one: ``prefix + name`` for each."""

    def __init__(self, groups: Mapping[str, dict[str, Any]]) -> None:
        self._places = {f"{p}{n}": (group, n) for p, group in groups.items() for n in group}

    def __getitem__(self, name: str) -> Any:
        group, own = self._places[name]
        return group[own]

    def __setitem__(self, name: str, tensor: Any) -> None:
        group, own = self._places[name]
        group[own] = tensor

    def __delitem__(self, name: str) -> None:
        raise TypeError("parameters are not removed")

    def __iter__(self) -> Iterator[str]:
        return iter(self._places)

    def __len__(self) -> int:
        return len(self._places)


class Adam:
    """Updates a dictionary of tensors in place from their gradients.

    Entries of hash grids whose gradient is 0 were not looked at by any sample: they and
    their moments stay as they are (Müller et al. 2022).
    """

    def __init__(
        self,
        parameters: MutableMapping[str, Any],
        *,
        beta1: float = 0.9,
        beta2: float = 0.999,
        epsilon: float = 1e-8,
        muon: bool = False,
    ) -> None:
        self._muon = muon
        self._parameters = parameters
        self._beta1, self._beta2, self._epsilon = beta1, beta2, epsilon
        self._first = {n: dr.zeros(type(p), p.shape) for n, p in parameters.items()}
        self._second = {n: dr.zeros(type(p), p.shape) for n, p in parameters.items()}
        float_type = type(next(iter(parameters.values())).array)
        self._steps = dr.zeros(float_type, 1)  # counts accepted steps only
        for name in parameters:
            self._renew(name, parameters[name])

    def zero_grad(self) -> None:
        """Forgets the gradients of all parameters."""
        for tensor in self._parameters.values():
            dr.clear_grad(tensor)

    def step(self, learning_rate: float, accept: Any) -> Any:
        """One update where ``accept`` (a mask of one element) and all gradients are finite.

        Returns:
            A mask of one element: whether the step was taken.
        """
        gradients = {n: dr.grad(p) for n, p in self._parameters.items()}
        accept = accept & _finite_squares(gradients.values())
        self._steps = self._steps + dr.select(accept, type(self._steps)(1), 0)
        rate = self._debiased_rate(learning_rate)
        dr.eval(rate, self._steps, accept)
        for name, g in gradients.items():
            old, m, v = self._parameters[name], self._first[name], self._second[name]
            m_new = dr.fma(m - g, self._beta1, g)
            v_new = dr.fma(v - dr.square(g), self._beta2, dr.square(g))
            if self._muon and is_hidden(old.shape):
                ahead = dr.lerp(g, m_new, self._beta1)  # Nesterov's momentum
                size = dr.opaque(type(rate), learning_rate * update_size(old.shape))
                new = dr.detach(old) - size * orthogonalized(ahead)
            else:
                new = dr.detach(old) - rate * m_new / (dr.sqrt(v_new) + self._epsilon)
            taken = accept & (g.array != 0) if name.endswith(GRID) else accept
            self._first[name] = _choose(taken, m_new, m)
            self._second[name] = _choose(taken, v_new, v)
            self._renew(name, _choose(taken, new, dr.detach(old)))
        dr.schedule(list(self._parameters.values()), self._first, self._second)
        dr.eval()
        return accept

    def state(self) -> dict[str, np.ndarray[Any, Any]]:
        """Moments and step count, by name; on the CPU where they lie, without a copy."""
        result = {f"first.{n}": np.asarray(t) for n, t in self._first.items()}
        result |= {f"second.{n}": np.asarray(t) for n, t in self._second.items()}
        result["steps"] = np.array(self._steps)
        return result

    def assign(self, name: str, value: Any) -> None:
        """Replaces one parameter."""
        self._renew(name, value)

    def restore(self, state: Mapping[str, np.ndarray[Any, Any]]) -> None:
        """Takes up the result of :meth:`state`.

        Raises:
            KeyError: if a tensor is missing.
            ValueError: if a tensor is of another shape.
        """
        for name, tensor in self._parameters.items():
            for moment in (f"first.{name}", f"second.{name}"):
                if state[moment].shape != tensor.shape:
                    raise ValueError(
                        f"tensor '{moment}' is {state[moment].shape}, expected {tensor.shape}"
                    )
            self._first[name] = upload(type(tensor), state[f"first.{name}"])
            self._second[name] = upload(type(tensor), state[f"second.{name}"])
        self._steps = upload(type(self._steps), state["steps"])

    def _renew(self, name: str, value: Any) -> None:
        value = dr.detach(value)
        dr.enable_grad(value)
        self._parameters[name] = value

    def _debiased_rate(self, learning_rate: float) -> Any:
        rate = dr.opaque(type(self._steps), learning_rate)
        bias1 = 1 - dr.power(self._beta1, self._steps)
        bias2 = 1 - dr.power(self._beta2, self._steps)
        return rate * dr.sqrt(bias2) / dr.select(bias1 > 0, bias1, 1)
