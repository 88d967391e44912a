"""Empirical descriptions: what no physical effect has to look like.

They are no part of the catalogue. Where one of them describes a residual better than every effect
that is, the residual is *unexplained*, and the description says along what, and where.
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
"""All of them."""

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
