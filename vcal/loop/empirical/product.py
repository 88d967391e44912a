"""Errors proportional to recorded quantities, or to products of two."""

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
    """One factor of a product: ((x - middle)/half)^power, or the same of the logarithm of x."""

    name: str
    middle: float
    half: float
    power: int = 1
    logarithm: bool = False

    def values(self, plan: Plan) -> np.ndarray:
        """Its values (n,) in the rows of a plan."""
        return self.of(plan.values(self.name))

    def of(self, x: np.ndarray) -> np.ndarray:
        """Its values at the values x (n,) of the quantity."""
        x = np.log(np.maximum(x, self.least)) if self.logarithm else x
        return ((x - self.middle) / self.half) ** self.power

    @property
    def least(self) -> float:
        """Smallest measured value of a quantity whose logarithm is used. Below it the factor stays
        constant.
        """
        return math.exp(self.middle - self.half)

    def code(self, read: Read) -> str:
        """Python code for its values."""
        value, middle = read(self.name), written(self.middle, self.half)
        if self.logarithm:
            value = f"jnp.log(jnp.maximum({value}, {self.least:.6g}))"
        power = f" ** {self.power}" if self.power != 1 else ""
        return f"(({value} - {middle}) / {self.half:.6g}){power}"


class Product(Empirical):
    """Base class of errors proportional to recorded quantities: a p, or a p q. The quantities are
    the shape parameter that is scanned.
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
        """The products that it may be proportional to."""


class Proportion(Product):
    """An error proportional to one recorded quantity that no effect of the catalogue uses.

    Quantities that effects use are described by these effects, and positions by the declared
    family. Quantities that an instrument derives, such as the time since the start of a run, are
    included.
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
    """An error proportional to the product of two recorded quantities, a p q.

    Quantities are counted from their middle, -1 to 1 over the measured range; positions are counted
    from their zero as well. Two positions also have products of higher order (u^2 v^2, u^3 v, u
    v^3).
    """

    name = "interaction"
    summary = "empirical: product of two quantities"
    words = "an error in proportion to the product of two quantities"

    @property
    def joint(self) -> bool:
        return True

    @classmethod
    def of(cls, setup: Setup) -> tuple[tuple[Factor, ...], ...]:
        return _products(setup.plan, setup.derived)


def quantities(plan: Plan, derived: Collection[str] = ()) -> dict[str, np.ndarray]:
    """Quantities that were recorded for every row and are no functions of others, (n,) each.

    `derived` quantities and angles that cover a full turn are left out; the latter wrap around.
    """
    around = angles_around(plan)
    return {
        name: x
        for name, x in distinct_covariates(plan).items()
        if name not in (*plan.groups, *derived, *around) and np.isfinite(x).all()
    }


def about_the_middle(name: str, x: np.ndarray, logarithm: bool = False) -> Factor:
    """A quantity, or its logarithm, scaled from -1 to 1."""
    x = np.log(x) if logarithm else x
    middle, half = 0.5 * float(x.max() + x.min()), 0.5 * float(np.ptp(x))
    return Factor(name, middle, half, logarithm=logarithm)


def _products(plan: Plan, derived: Collection[str]) -> tuple[tuple[Factor, ...], ...]:
    """Pairs of quantities whose products are tried."""
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
