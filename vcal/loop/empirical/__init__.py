"""Empirical descriptions: functions of covariates without a physical cause.

They are not part of the catalogue. Where one of them describes a residual better than every effect
of the catalogue, the residual is *unexplained*, and the description says on which covariate it
depends, and where. Knows `effects` and the plan, nothing of fits. All later stages, the report and
the plots stand on it.
"""

from .base import Empirical, Interval
from .changing import Changing
from .harmonic import Harmonic
from .moment import Since
from .position import Kink, LocalBump
from .product import Factor, Interaction, Product, Proportion

EMPIRICAL: tuple[type[Empirical], ...] = (
    LocalBump,
    Kink,
    Proportion,
    Interaction,
    Harmonic,
    Since,
    Changing,
)
"""All empirical descriptions."""

__all__ = [
    "EMPIRICAL",
    "Changing",
    "Empirical",
    "Factor",
    "Harmonic",
    "Interaction",
    "Interval",
    "Kink",
    "LocalBump",
    "Product",
    "Proportion",
    "Since",
]
