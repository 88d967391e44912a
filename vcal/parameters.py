"""Named parameters with unit and prior."""

import math
from dataclasses import dataclass, replace
from typing import Literal

from .units import in_name, si_factor


@dataclass(frozen=True)
class Parameter:
    """One parameter of an effect.

    An *amplitude* enters the deviation linearly; its prior is normal with mean `mean` and standard
    deviation `sigma` (`math.inf`: flat; zero: known). A *shape* parameter (a pitch, a time
    constant, a moment) enters non-linearly; its prior is uniform over the interval that is
    scanned, in the coordinate in which the scan has equal steps.
    """

    name: str
    """Name without unit, such as ``"size"``."""
    unit: str
    """Unit at the edges, such as ``"um"``; inside, values are SI."""
    sigma: float = math.inf
    """Prior standard deviation of an amplitude, in `unit`."""
    mean: float = 0.0
    """Prior mean of an amplitude, or declared value of a shape parameter, in `unit`."""
    scale: float = 1.0
    """Size that counts as one for the solver where the prior is flat, in `unit`."""
    shape: bool = False
    """Whether the parameter enters non-linearly."""
    coordinate: Literal["linear", "reciprocal", "log"] = "linear"
    """Coordinate in which a shape parameter is scanned with equal steps."""
    smooth: bool = True
    """Whether the deviation is differentiable in a shape parameter (the time of a jump is not)."""

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
        """What the solver counts as one, in SI: the prior sigma, or `scale` if that is flat."""
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
        return replace(self, mean=mean, sigma=sigma)
