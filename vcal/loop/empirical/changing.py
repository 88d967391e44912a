"""Effects of the model whose parameters change with a recorded quantity."""

import dataclasses
from collections.abc import Iterable, Mapping
from typing import Any

import equinox as eqx
import numpy as np

from ...effects.base import Effect, Response, Setup
from ...effects.registry import CATALOGUE
from ...machine.parameters import Parameter
from ...machine.plan import Plan
from ...numerics.arrays import Array
from .base import Code, Empirical, Read
from .covariates import distinct_covariates, has_zero
from .product import Factor, about_the_middle, quantities

_MOST = 9
"""Most amplitudes of such an effect: more belong to a family, not to an effect."""
_SEQUENCE = ("run", "pose")
"""Groups whose number increases with time."""
_STEP = 0.05
"""Relative step of shape parameters for numerical derivatives."""
_RATIO = 2.0
"""Ratio of the largest to the smallest value from which the logarithm of a quantity with a natural
zero is tried."""


class Changing(Empirical):
    """An effect of the model whose parameters change with a recorded quantity u.

    To first order, every amplitude a changes by a' u and every shape parameter s that is a scale by
    s s' u. u is the quantity, or its logarithm where that fits better, from -1 to 1 over the
    measured range. Examples are backlash that grows along an axis, and quadrant peaks whose height
    falls with the acceleration.
    """

    name = "changing"
    summary = "empirical: effect of the model that changes with a quantity"
    words = "an effect that changes with a quantity"
    effect: Effect
    shape: tuple[tuple[str, float], ...] = eqx.field(static=True)
    """Its shape parameters as identified, SI."""
    sizes: tuple[tuple[str, float], ...] = eqx.field(static=True)
    """Its amplitudes as identified, SI."""
    quantities: tuple[Factor, ...] = eqx.field(static=True, repr=False)

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        own = tuple(
            Parameter(p.name, p.unit, sigma=max(abs(size) / p.si, _expected(p)))
            for p, (_, size) in zip(self.effect.amplitudes, self.sizes, strict=True)
        )
        return (
            *own,
            *(Parameter(name, "1", sigma=1.0) for name in self._scales),
            Parameter("which", "1", shape=True, smooth=False, choice=True),
        )

    @property
    def where(self):  # type: ignore[override]
        """Where the effect acts that changes."""
        return self.effect.where

    @property
    def needs(self) -> tuple[str, ...]:
        return self.effect.needs

    def needs_at(self, shape: Mapping[str, float]) -> tuple[str, ...]:
        return (*self.needs, self._quantity(shape).name)

    def depends_on(self, plan: Plan, shape: Mapping[str, float]) -> tuple[str, ...]:
        del plan
        return (self._quantity(shape).name, *self.effect.indicators)

    def said(self, shape: Mapping[str, float]) -> str:
        del shape
        return f"{self.effect.key} that changes with a quantity"

    def response(self, plan: Plan, shape: Mapping[str, Array]) -> Response:
        which = np.asarray(shape["which"]).astype(int)
        index = which if which.ndim == 0 else which[:, 0]
        values = np.array([self.quantities[int(i)].values(plan) for i in np.atleast_1d(index)])
        u = values[0] if which.ndim == 0 else values
        return {key: np.asarray(moved) * u for key, moved in self._slopes(plan).items()}

    def scan(self, plan: Plan) -> Mapping[str, np.ndarray]:
        del plan
        return {"which": np.arange(float(len(self.quantities)))}

    @property
    def coded(self) -> bool:
        """Whether the effect is one of the catalogue and its fields can be written in a file."""
        written = all(
            isinstance(value, str | int | float | tuple) for value in self._placed.values()
        )
        return written and CATALOGUE.get(self.effect.name) is type(self.effect)

    def code(self, plan: Plan, shape: Mapping[str, float], read: Read) -> Code:
        given = ", ".join(f"{name}={value!r}" for name, value in self._placed.items())
        lines = [
            f"u = {self._quantity(shape).code(read)}",
            f'effect = vcal.CATALOGUE["{self.effect.name}"]({given})',
        ]
        at = {name: float(f"{value:.12g}") for name, value in self.shape}
        lines.append(f"moved = effect.response(plan, {at})")
        for name in self._scales:
            more, less = ({**at, name: at[name] * (1.0 + s)} for s in (_STEP, -_STEP))
            lines.append(f"more_{name} = effect.response(plan, {more})")
            lines.append(f"less_{name} = effect.response(plan, {less})")
        found: dict[tuple[str, str], str] = {}
        sizes = dict(self.sizes)
        for port, name in self._moved(plan):
            found[port, name] = f'moved["{port}", "{name}"] * u'
            for scale in self._scales:
                change = (
                    f'(more_{scale}["{port}", "{name}"] - less_{scale}["{port}", "{name}"])'
                    f" * ({sizes[name] / (2.0 * _STEP):.6g} * u)"
                )
                before = found.get((port, scale))
                found[port, scale] = f"{before} + {change}" if before else change
        return lines, found

    @property
    def _placed(self) -> dict[str, Any]:
        """The fields that the effect is constructed from, without declared values and priors."""
        fields = (f.name for f in dataclasses.fields(self.effect) if f.init)
        return {
            name: getattr(self.effect, name) for name in fields if name not in ("given", "priors")
        }

    def _quantity(self, shape: Mapping[str, float]) -> Factor:
        return self.quantities[int(shape["which"])]

    @property
    def _scales(self) -> tuple[str, ...]:
        """Shape parameters that are lengths or times. Positions are not scales. Nor are lengths of
        periods: over many periods their change is no change of scale.
        """
        return tuple(p.name for p in self.effect.shapes if p.moves and p.coordinate == "log")

    def _moved(self, plan: Plan, **other: float) -> Response:
        at = {**dict(self.shape), **other}
        return self.effect.response(plan, {name: np.asarray(value) for name, value in at.items()})

    def _slopes(self, plan: Plan) -> dict[tuple[str, str], Array]:
        """Derivative of the displacement by each parameter, by port and parameter."""
        found: dict[tuple[str, str], Array] = dict(self._moved(plan))
        at, sizes = dict(self.shape), dict(self.sizes)
        for scale in self._scales:
            more, less = (
                self._moved(plan, **{scale: at[scale] * (1.0 + step)}) for step in (_STEP, -_STEP)
            )
            for (port, name), moved in more.items():
                change = (moved - less[port, name]) * (sizes[name] / (2.0 * _STEP))
                found[port, scale] = found.get((port, scale), 0.0) + change
        return found

    @classmethod
    def candidates(cls, setup: Setup) -> Iterable[Effect]:
        if not setup.fitted:
            return
        known = quantities(setup.plan)
        known |= {n: x for n, x in distinct_covariates(setup.plan).items() if n in _SEQUENCE}
        factors = [about_the_middle(name, x) for name, x in known.items()]
        factors += [
            about_the_middle(name, x, logarithm=True)
            for name, x in known.items()
            if has_zero(setup.plan, name) and x.min() > 0.0 and x.max() > _RATIO * x.min()
        ]
        for one in setup.fitted:
            own = one.effect.amplitudes
            sized = all(one.sizes[p.name] or _expected(p) for p in own)
            if not (factors and len(own) <= _MOST and sized):
                continue
            found = cls(
                port="",
                unit="",
                effect=one.effect,
                shape=tuple(one.shape.items()),
                sizes=tuple(one.sizes.items()),
                quantities=tuple(factors),
                placement=one.effect.placement,
            )
            moved = [np.asarray(values) for values in found._moved(setup.plan).values()]
            kept = [f for f in factors if not _constant(moved, f.values(setup.plan))]
            if kept:
                yield dataclasses.replace(found, quantities=tuple(kept))


def _constant(moved: Iterable[np.ndarray], u: np.ndarray) -> bool:
    """Whether the displacement times u is constant wherever it is not zero. Backlash times its own
    sense of travel is an example: it differs only in rows whose sense of travel is unknown.
    """
    products = [values * u for values in moved]
    sizes = [p[np.abs(p) > 0.0] for p in products]
    return all(not len(p) or np.ptp(p) <= 1e-9 * np.abs(p).max() for p in sizes)


def _expected(parameter: Parameter) -> float:
    """The prior standard deviation, where there is one and the value is not declared; else zero."""
    return parameter.sigma if parameter.informed else 0.0
