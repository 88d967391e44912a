"""Named parameters with unit and prior."""

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Literal

import equinox as eqx
import numpy as np

from ..distributions import Distribution, Univariate
from ..errors import StudyError
from ..numerics.record import Record
from ..units import in_name, si_factor


@dataclass(frozen=True)
class Parameter:
    """One parameter of an effect. Raises `StudyError` for a unit that vcal does not know.

    An *amplitude* enters the deviation linearly. Its prior has the mean `mean` and the standard
    deviation `sigma` (`math.inf`: flat; zero: known), and is normal unless there is a `law`. A
    *shape* parameter (a pitch, a time constant, a point of time) enters non-linearly. Its prior is
    uniform over the scanned interval, in the coordinate in which the scan has equal steps.
    """

    name: str
    """Name without unit, such as ``"size"``."""
    unit: str
    """Unit in files and reports, such as ``"um"``; internal values are in SI."""
    sigma: float = math.inf
    """Prior standard deviation of an amplitude, in `unit`."""
    mean: float = 0.0
    """Prior mean of an amplitude, or declared value of a shape parameter, in `unit`."""
    scale: float = 1.0
    """Solver unit of an amplitude with a flat prior, in `unit`."""
    shape: bool = False
    """Whether the parameter enters non-linearly."""
    coordinate: Literal["linear", "reciprocal", "log"] = "linear"
    """Coordinate in which a shape parameter is scanned with equal steps."""
    smooth: bool = True
    """Whether the deviation is differentiable in a shape parameter (the time of a jump is not)."""
    choice: bool = False
    """Whether a shape parameter is an index of alternatives that have no order."""
    largest: float = 100.0
    """Size of an amplitude, in prior standard deviations, beyond which it is physically impossible.
    """
    law: Univariate | None = field(default=None, compare=False, repr=False)
    """Distribution from which machines are drawn, where it is not the default prior.

    For an amplitude, any distribution whose standardised form is that of the parameter; for a shape
    parameter, its distribution in `unit`. An identification uses only mean and standard deviation.
    """

    def __post_init__(self) -> None:
        if not isinstance(self.unit, str):
            return  # what is not text is reported with the class that made it
        try:
            si_factor(self.unit)
        except ValueError as error:
            raise StudyError(f"{self.name}: {error}; correct the unit") from error

    @property
    def label(self) -> str:
        """Name with unit, as used in files and reports: ``"size_um"``."""
        unit = in_name(self.unit)
        return f"{self.name}_{unit}" if unit and unit != "1" else self.name

    @property
    def si(self) -> float:
        """Factor from `unit` to SI."""
        return si_factor(self.unit)

    @property
    def step(self) -> float:
        """Solver unit in SI: the prior sigma, or `scale` if the prior is flat."""
        return self.si * (self.sigma if math.isfinite(self.sigma) else self.scale)

    @property
    def informed(self) -> bool:
        """Whether the prior is proper."""
        return math.isfinite(self.sigma)

    @property
    def known(self) -> bool:
        """Whether its value is declared and not to be estimated."""
        return self.sigma == 0.0

    @property
    def moves(self) -> bool:
        """Whether it is a shape parameter that the solver moves."""
        return self.shape and self.smooth and not self.known

    def with_prior(self, mean: float, sigma: float) -> "Parameter":
        """The same parameter with another prior mean and standard deviation (in `unit`)."""
        return replace(self, mean=mean, sigma=sigma, law=None)


class Prior(Record):
    """Distribution of parameters of one effect before any measurement.

    ``Prior("alpha", Uniform(8, 12))`` or, for correlated parameters,
    ``Prior(("sine", "cosine"), MultivariateNormal(mean, covariance))``, in the units of the
    parameters. Machines are drawn from this distribution. An identification uses its means and
    standard deviations, but neither its shape nor its correlations.

    Raises `ValueError` unless there is one name for every number of a draw.
    """

    names: tuple[str, ...] = eqx.field(static=True)
    distribution: Distribution

    def __init__(self, names: str | Sequence[str], distribution: Distribution):
        self.names = (names,) if isinstance(names, str) else tuple(names)
        self.distribution = distribution
        numbers = math.prod(distribution.shape)
        if len(self.names) != numbers or len(set(self.names)) != numbers:
            raise ValueError(
                f"prior of {', '.join(self.names)}: found a distribution of {numbers} numbers, "
                "expected one for every parameter, each named once"
            )

    @property
    def mean(self) -> tuple[float, ...]:
        """Expectation of every parameter, in its unit."""
        return tuple(np.ravel(self.distribution.mean).tolist())

    @property
    def sigma(self) -> tuple[float, ...]:
        """Standard deviation of every parameter, in its unit."""
        return tuple(np.sqrt(np.diagonal(self.distribution.covariance)).tolist())

    def of(self, parameter: Parameter) -> Parameter:
        """The parameter with this prior.

        Raises `ValueError` for a shape parameter in a distribution of several parameters.
        """
        law = self.distribution if isinstance(self.distribution, Univariate) else None
        if parameter.shape:
            if law is None:
                raise ValueError(
                    f"prior of {', '.join(self.names)}: found the shape parameter "
                    f"{parameter.name} in a distribution of several, expected one of its own"
                )
            return replace(parameter, law=law)
        i = self.names.index(parameter.name)
        return replace(parameter, mean=self.mean[i], sigma=self.sigma[i], law=law)


def in_units(parameters: Iterable[Parameter], values: Mapping[str, float]) -> dict[str, float]:
    """Values (SI) of these parameters in their units, by name."""
    return {p.name: values[p.name] / p.si for p in parameters}
