"""Empirical descriptions: what no physical effect has to look like.

They are no part of the catalogue. Where one of them describes a residual better than every effect
that is, the residual is *unexplained*, and the description says along what, and where.
"""

import abc
import itertools
from collections.abc import Callable, Collection, Iterable, Mapping
from dataclasses import dataclass, replace
from typing import ClassVar

import equinox as eqx
import numpy as np

from ..arrays import Array, namespace
from ..effects.base import Effect, Response, Setup
from ..parameters import Parameter
from ..plan import Plan
from .recorded import distinct_covariates


@dataclass(frozen=True)
class Interval:
    """A stretch of a covariate, in SI."""

    covariate: str
    low: float
    high: float


Read = Callable[[str], str]
"""Python for the values of a covariate by its name."""
Code = tuple[list[str], dict[str, str]]
"""Lines of Python, and an expression for every amplitude."""


class Empirical(Effect):
    """Base class of the descriptions: functions of covariates in one error motion of an axis, of
    free size.
    """

    words: ClassVar[str]
    """What it is, for a sentence: *a local error*."""
    port: str = eqx.field(static=True)
    unit: str = eqx.field(static=True)

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        return (Parameter("size", self.unit, sigma=10.0),)

    @property
    def needs(self) -> tuple[str, ...]:
        return (self.placement,)

    def depends_on(self, plan: Plan, shape: Mapping[str, float]) -> tuple[str, ...]:
        """Covariates that it depends on, first of all that along which it has its shape."""
        del plan, shape
        return self.needs

    @property
    def joint(self) -> bool:
        """Whether it is a product of the first two of them."""
        return False

    def intervals(self, plan: Plan, shape: Mapping[str, float]) -> tuple[Interval, ...]:
        """Where it sits; nothing where it is everywhere."""
        del plan, shape
        return ()

    @abc.abstractmethod
    def code(self, plan: Plan, shape: Mapping[str, float], read: Read) -> Code:
        """Lines of Python that prepare what it needs from what `read` gives for a covariate, and
        the expression of every amplitude of one.
        """

    @classmethod
    def candidates(cls, setup: Setup) -> Iterable[Effect]:
        for axis in setup.chain.axes:
            for c in "XYZABC":
                yield cls(port=f"E{c}{axis}", unit="um" if c in "XYZ" else "urad", placement=axis)

    def _length(self) -> str:
        return "rad" if self.placement.startswith("J") else "mm"


class LocalBump(Empirical):
    """A bump of Gaussian form in one error motion: a exp(-((x - centre)/width)^2 / 2)."""

    name = "local_bump"
    summary = "empirical: local error"
    words = "a local error"

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        return (
            Parameter("height", self.unit, sigma=10.0),
            Parameter("centre", self._length(), shape=True),
            Parameter("width", self._length(), shape=True, coordinate="log"),
        )

    def response(self, plan: Plan, shape: Mapping[str, Array]) -> Response:
        u = (plan.x(self.placement) - shape["centre"]) / shape["width"]
        return {(self.port, "height"): namespace(u).exp(-0.5 * u * u)}

    def scan(self, plan: Plan) -> Mapping[str, np.ndarray]:
        low, high = _range(plan, self.placement)
        span = (high - low) or 1.0
        return {
            "centre": np.linspace(low, high, 41),
            # Wider than a tenth of the travel is a matter of the declared family's smoothness.
            "width": np.geomspace(span / 80.0, span / 10.0, 4),
        }

    def intervals(self, plan: Plan, shape: Mapping[str, float]) -> tuple[Interval, ...]:
        half = 2.0 * shape["width"]
        return (Interval(self.placement, shape["centre"] - half, shape["centre"] + half),)

    def code(self, plan: Plan, shape: Mapping[str, float], read: Read) -> Code:
        del plan
        return (
            [f"u = ({read(self.placement)} - {shape['centre']:.6g}) / {shape['width']:.4g}"],
            {"height": "jnp.exp(-0.5 * u * u)"},
        )


class Kink(Empirical):
    """An error motion whose slope changes at one position: a max(0, x - at), as where two
    guideways join.
    """

    name = "kink"
    summary = "empirical: change of slope at one position"
    words = "a kink"

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        slope = f"{self.unit}/{'rad' if self._length() == 'rad' else 'm'}"
        return (
            Parameter("slope", slope, sigma=50.0),
            Parameter("at", self._length(), shape=True),
        )

    def response(self, plan: Plan, shape: Mapping[str, Array]) -> Response:
        beyond = plan.x(self.placement) - shape["at"]
        return {(self.port, "slope"): namespace(beyond).maximum(beyond, 0.0)}

    def scan(self, plan: Plan) -> Mapping[str, np.ndarray]:
        low, high = _range(plan, self.placement)
        return {"at": low + (high - low) * np.linspace(0.1, 0.9, 33)}

    def intervals(self, plan: Plan, shape: Mapping[str, float]) -> tuple[Interval, ...]:
        return (Interval(self.placement, shape["at"], _range(plan, self.placement)[1]),)

    def code(self, plan: Plan, shape: Mapping[str, float], read: Read) -> Code:
        del plan
        return (
            [f"x = {read(self.placement)}"],
            {"slope": f"jnp.maximum(x - {shape['at']:.6g}, 0.0)"},
        )


@dataclass(frozen=True)
class Factor:
    """One factor of a product: ((x - middle)/half)^power."""

    name: str
    middle: float
    half: float
    power: int = 1

    def values(self, plan: Plan) -> np.ndarray:
        """Its values (n,)."""
        return ((plan.values(self.name) - self.middle) / self.half) ** self.power


class Product(Empirical):
    """Base class of what is in proportion to recorded quantities: a p, or a p q. Of what it is, is
    scanned.
    """

    products: tuple[tuple[Factor, ...], ...] = eqx.field(static=True, repr=False)

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        return (
            Parameter("size", self.unit, sigma=10.0),
            Parameter("which", "1", shape=True, smooth=False, choice=True),
        )

    @property
    def needs(self) -> tuple[str, ...]:
        return (self.placement,) if self.placement else ()

    def needs_at(self, shape: Mapping[str, float]) -> tuple[str, ...]:
        return (*self.needs, *(factor.name for factor in self.products[int(shape["which"])]))

    def depends_on(self, plan: Plan, shape: Mapping[str, float]) -> tuple[str, ...]:
        del plan
        return tuple(factor.name for factor in self.products[int(shape["which"])])

    def response(self, plan: Plan, shape: Mapping[str, Array]) -> Response:
        which = np.asarray(shape["which"]).astype(int)
        factors = {factor for one in self.products for factor in one}
        if which.ndim == 0:
            factors = set(self.products[int(which)])
        values = {factor: factor.values(plan) for factor in factors}

        def product(i: int) -> np.ndarray:
            return np.prod([values[factor] for factor in self.products[i]], axis=0)

        found = (
            product(int(which)) if which.ndim == 0 else np.array([product(i) for i in which[:, 0]])
        )
        return {(self.port, "size"): found}

    def scan(self, plan: Plan) -> Mapping[str, np.ndarray]:
        del plan
        return {"which": np.arange(float(len(self.products)))}

    def code(self, plan: Plan, shape: Mapping[str, float], read: Read) -> Code:
        del plan
        factors = self.products[int(shape["which"])]
        letters = "uv"[: len(factors)]
        lines = [
            f"{letter} = (({read(factor.name)} - {factor.middle:.6g}) / {factor.half:.4g})"
            + (f" ** {factor.power}" if factor.power != 1 else "")
            for letter, factor in zip(letters, factors, strict=True)
        ]
        return lines, {"size": " * ".join(letters)}

    @classmethod
    def candidates(cls, setup: Setup) -> Iterable[Effect]:
        products = cls.of(setup)
        if not products:
            return
        for c in "XYZ":
            if f"tool.{c}" in setup.layout:
                yield cls(port=f"tool.{c}", unit="um", products=products)
        for axis in setup.chain.axes:
            for c in "ABC":
                yield cls(port=f"E{c}{axis}", unit="urad", products=products, placement=axis)

    @classmethod
    @abc.abstractmethod
    def of(cls, setup: Setup) -> tuple[tuple[Factor, ...], ...]:
        """What it may be in proportion to."""


class Proportion(Product):
    """An error in proportion to one recorded quantity that no effect of the catalogue looks at.

    What effects look at, they have as well; positions are the declared family's matter. What an
    instrument derives counts too, such as the time since the start of a run.
    """

    name = "proportion"
    summary = "empirical: in proportion to a recorded quantity"
    words = "an error in proportion to a quantity"

    @classmethod
    def of(cls, setup: Setup) -> tuple[tuple[Factor, ...], ...]:
        known = _quantities(setup.plan)
        free = [name for name in known if name not in setup.plan.axes and name not in setup.used]
        return tuple((_about_the_middle(name, known[name]),) for name in free)


class Interaction(Product):
    """An error in proportion to the product of two recorded quantities, a p q.

    Quantities count from their middle, -1 to 1 over what was measured, positions from their zero as
    well; of two positions there are products of higher order, too (u^2 v^2, u^3 v, u v^3).
    """

    name = "interaction"
    summary = "empirical: product of two quantities"
    words = "an error that two quantities make together"

    @property
    def joint(self) -> bool:
        return True

    @classmethod
    def of(cls, setup: Setup) -> tuple[tuple[Factor, ...], ...]:
        return _products(setup.plan, setup.derived)


def _quantities(plan: Plan, derived: Collection[str] = ()) -> dict[str, np.ndarray]:
    """What was recorded of every row, none a function of others, without what was `derived`."""
    return {
        name: x
        for name, x in distinct_covariates(plan).items()
        if name not in plan.groups and name not in derived and np.isfinite(x).all()
    }


def _about_the_middle(name: str, x: np.ndarray, power: int = 1) -> Factor:
    return Factor(name, 0.5 * float(x.max() + x.min()), 0.5 * float(np.ptp(x)), power)


def _products(plan: Plan, derived: Collection[str]) -> tuple[tuple[Factor, ...], ...]:
    """Pairs of quantities whose product says more than either."""
    known = _quantities(plan, derived)
    factors = [_about_the_middle(name, x) for name, x in known.items()]
    positions = [factor for factor in factors if factor.name in plan.axes]
    factors += [Factor(p.name, 0.0, p.half) for p in positions if abs(p.middle) > 0.2 * p.half]
    pairs = [(p, q) for p, q in itertools.combinations(factors, 2) if p.name != q.name]
    for first, second in itertools.combinations(positions, 2):
        pairs += [
            (replace(first, power=p), replace(second, power=q)) for p, q in ((2, 2), (3, 1), (1, 3))
        ]
    return tuple(pairs)


class Since(Empirical):
    """An error in proportion to the position, from one moment on: (a + b (t - at)) x for t > at, as
    where a compensation is no longer fed with what it needs.
    """

    name = "scale_since"
    summary = "empirical: error in proportion to the position, from one moment on"
    words = "an error that grows with the position from one moment on"

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        per = "rad" if self._length() == "rad" else "m"
        return (
            Parameter("step", f"{self.unit}/{per}", sigma=20.0),
            Parameter("ramp", f"{self.unit}/({per} h)", sigma=20.0),
            Parameter("at", "s", shape=True, smooth=False),
        )

    @property
    def needs(self) -> tuple[str, ...]:
        return (self.placement, "t")

    @property
    def joint(self) -> bool:
        return True

    def response(self, plan: Plan, shape: Mapping[str, Array]) -> Response:
        x, after = plan.x(self.placement), plan.covariate("t") - shape["at"]
        xp = namespace(x, after)
        return {
            (self.port, "step"): xp.where(after > 0.0, x, 0.0),
            (self.port, "ramp"): x * xp.maximum(after, 0.0),
        }

    def scan(self, plan: Plan) -> Mapping[str, np.ndarray]:
        t = np.unique(np.asarray(plan.covariate("t")))
        return {"at": np.unique(np.quantile(t, np.linspace(0.05, 0.95, 31)))}

    def intervals(self, plan: Plan, shape: Mapping[str, float]) -> tuple[Interval, ...]:
        return (Interval("t", shape["at"], float(np.max(plan.covariate("t")))),)

    def code(self, plan: Plan, shape: Mapping[str, float], read: Read) -> Code:
        del plan
        return (
            [f"x = {read(self.placement)}", f"after = {read('t')} - {shape['at']:.6g}  # s"],
            {"step": "jnp.where(after > 0, x, 0.0)", "ramp": "x * jnp.maximum(after, 0.0)"},
        )


EMPIRICAL: tuple[type[Empirical], ...] = (LocalBump, Kink, Proportion, Interaction, Since)
"""All of them."""


def _range(plan: Plan, axis: str) -> tuple[float, float]:
    x = np.asarray(plan.x(axis))
    return float(x.min()), float(x.max())
