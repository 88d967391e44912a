"""Which effects could be missing: every class of the catalogue, at every place it could sit."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from ..arrays import Array
from ..effects.base import Effect, Response, Setup
from ..effects.data_set import in_setup
from ..measurement import Measurement
from ..model import Model
from ..parameters import Parameter
from ..plan import Plan


@dataclass(frozen=True)
class Untestable:
    """An effect that could not be tested on this data, and why."""

    effect: str
    placement: str
    reason: str
    missing: tuple[tuple[str, tuple[str, ...]], ...] = ()
    """Covariates that it needs and the data sets that lack each: none of these where there is only
    one data set, or where all have it and do not share it.
    """


def candidates(
    model: Model, measurement: Measurement, classes: Iterable[type[Effect]]
) -> tuple[list[Effect], list[Untestable]]:
    """Instances the data can speak about, and those it cannot for want of a covariate."""
    setup, plan = model.setup(measurement.plan), measurement.plan
    present = {_identity(effect) for effect in model.effects}
    found, missing = [], {}
    for cls in classes:
        if cls.kind != "systematic":
            continue
        for effect in in_setup(cls, setup):
            if _identity(effect) in present:
                continue
            absent = [name for name in effect.needs if not plan.has(name)]
            if absent:
                missing[effect.name, effect.placement] = [_wanting(plan, name) for name in absent]
            else:
                found.append(effect)
    return found, [
        Untestable(name, place, "; ".join(_reasons(wanted, plan.sets)), tuple(wanted))
        for (name, place), wanted in missing.items()
    ]


def _wanting(plan: Plan, name: str) -> tuple[str, tuple[str, ...]]:
    """A covariate that is not there, and the data sets that lack it."""
    owner, _, plain = name.partition(":")
    return (plain, (owner,)) if owner in plan.sets else (name, plan.lacking(name))


def _reasons(wanted: list[tuple[str, tuple[str, ...]]], sets: tuple[str, ...]) -> list[str]:
    """Why covariates are not there, in words: one reason for those that the same data sets lack."""
    alike: dict[tuple[str, ...], list[str]] = {}
    for name, lacking in wanted:
        alike.setdefault(lacking, []).append(name)
    reasons = []
    for lacking, names in alike.items():
        listed = ", ".join(names)
        if not sets or lacking == sets:
            reasons.append(f"the data have no {listed}")
        elif not lacking:
            reasons.append(f"the data sets do not share their {listed}")
        else:
            reasons.append(
                f"{' and '.join(lacking)} {'have' if lacking[1:] else 'has'} no {listed}"
            )
    return reasons


def _identity(effect: Effect) -> tuple[str, str, tuple[str, ...]]:
    return effect.name, effect.placement, tuple(p.name for p in effect.parameters)


class LocalBump(Effect):
    """A bump of Gaussian form in one error motion: what no physical effect has to look like.

    a exp(-((x - centre)/width)^2 / 2). Not in the catalogue: where it describes the residual better
    than every effect that is, the residual is *unexplained*, and this says where it sits.
    """

    name = "local_bump"
    summary = "empirical description of a local error"
    port: str = eqx.field(static=True)
    unit: str = eqx.field(static=True)

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        unit = "rad" if self.placement.startswith("J") else "mm"
        return (
            Parameter("height", self.unit, sigma=10.0),
            Parameter("centre", unit, shape=True),
            Parameter("width", unit, shape=True, coordinate="log"),
        )

    @property
    def needs(self) -> tuple[str, ...]:
        return (self.placement,)

    def response(self, plan: Plan, shape: Mapping[str, Array]) -> Response:
        u = (plan.x(self.placement) - shape["centre"]) / shape["width"]
        return {(self.port, "height"): jnp.exp(-0.5 * u * u)}

    def scan(self, plan: Plan) -> Mapping[str, np.ndarray]:
        x = np.asarray(plan.x(self.placement))
        low, high = float(x.min()), float(x.max())
        span = (high - low) or 1.0
        return {
            "centre": np.linspace(low, high, 41),
            # Wider than a tenth of the travel is a matter of the declared family's smoothness.
            "width": np.geomspace(span / 80.0, span / 10.0, 4),
        }

    @classmethod
    def candidates(cls, setup: Setup) -> Iterable[Effect]:
        for axis in setup.chain.axes:
            for c in "XYZABC":
                yield cls(port=f"E{c}{axis}", unit="um" if c in "XYZ" else "urad", placement=axis)
