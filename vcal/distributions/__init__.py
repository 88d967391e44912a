"""Distributions of quantities, as priors of parameters and inputs of propagation and Monte Carlo;
importing the package fills the catalogue.
"""

from .base import Distribution, Multivariate, Univariate
from .bounded import Arcsine, Trapezoidal, Triangular, Uniform
from .copula import GaussianCopula
from .empirical import Empirical
from .inexact import CurvilinearTrapezoid
from .inputs import Inputs
from .multivariate import MultivariateNormal, MultivariateT
from .normal import Normal, StudentT
from .registry import CATALOGUE, distribution, distribution_class
from .shaped import Beta, Gamma, LogNormal

__all__ = [
    "CATALOGUE",
    "Arcsine",
    "Beta",
    "CurvilinearTrapezoid",
    "Distribution",
    "Empirical",
    "Gamma",
    "GaussianCopula",
    "Inputs",
    "LogNormal",
    "Multivariate",
    "MultivariateNormal",
    "MultivariateT",
    "Normal",
    "StudentT",
    "Trapezoidal",
    "Triangular",
    "Uniform",
    "Univariate",
    "distribution",
    "distribution_class",
]
