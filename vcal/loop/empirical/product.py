"""Errors in proportion to what was recorded, or to products of it."""

import abc
import itertools
import math
from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass, replace

import equinox as eqx
import numpy as np

from ...effects.base import Effect, Response, Setup
from ...machine.parameters import Parameter
from ...machine.plan import Plan
from ...numerics.arrays import Array
from .base import Code, Empirical, Read, written
from .covariates import angles_around, distinct_covariates


@dataclass(frozen=True)
class Factor:
    """One factor of a product: ((x - middle)/half)^power, or of the logarithm of x."""

    name: str
    middle: float
    half: float
    power: int = 1
    logarithm: bool = False

    def values(self, plan: Plan) -> np.ndarray:
        """Its values (n,)."""
        return self.of(plan.values(self.name))

    def of(self, x: np.ndarray) -> np.ndarray:
        """Its values where the quantity has these."""
        x = np.log(np.maximum(x, self.least)) if self.logarithm else x
        return ((x - self.middle) / self.half) ** self.power

    @property
    def least(self) -> float:
        """The smallest value that a logarithm was measured at: below, it stays what it is there."""
        return math.exp(self.middle - self.half)

    def code(self, read: Read) -> str:
        """Python for its values."""
        value, middle = read(self.name), written(self.middle, self.half)
        if self.logarithm:
            value = f"jnp.log(jnp.maximum({value}, {self.least:.6g}))"
        power = f" ** {self.power}" if self.power != 1 else ""
        return f"(({value} - {middle}) / {self.half:.6g}){power}"


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
            f"{letter} = {factor.code(read)}"
            for letter, factor in zip(letters, factors, strict=True)
        ]
        return lines, {(self.port, "size"): " * ".join(letters)}

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
        known = quantities(setup.plan)
        free = [name for name in known if name not in setup.plan.axes and name not in setup.used]
        return tuple((about_the_middle(name, known[name]),) for name in free)


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


def quantities(plan: Plan, derived: Collection[str] = ()) -> dict[str, np.ndarray]:
    """What was recorded of every row, none a function of others, without what was `derived`, and
    without angles that go round: they begin anew somewhere.
    """
    around = angles_around(plan)
    return {
        name: x
        for name, x in distinct_covariates(plan).items()
        if name not in (*plan.groups, *derived, *around) and np.isfinite(x).all()
    }


def about_the_middle(name: str, x: np.ndarray, logarithm: bool = False) -> Factor:
    """A quantity, or its logarithm, from -1 to 1."""
    x = np.log(x) if logarithm else x
    middle, half = 0.5 * float(x.max() + x.min()), 0.5 * float(np.ptp(x))
    return Factor(name, middle, half, logarithm=logarithm)


def _products(plan: Plan, derived: Collection[str]) -> tuple[tuple[Factor, ...], ...]:
    """Pairs of quantities whose product says more than either."""
    known = quantities(plan, derived)
    factors = [about_the_middle(name, x) for name, x in known.items()]
    positions = [factor for factor in factors if factor.name in plan.axes]
    factors += [Factor(p.name, 0.0, p.half) for p in positions if abs(p.middle) > 0.2 * p.half]
    pairs = [(p, q) for p, q in itertools.combinations(factors, 2) if p.name != q.name]
    for first, second in itertools.combinations(positions, 2):
        pairs += [
            (replace(first, power=p), replace(second, power=q)) for p, q in ((2, 2), (3, 1), (1, 3))
        ]
    return tuple(pairs)
