"""Distributions of quantities (JCGM 101, 6.4): priors of parameters, inputs of uncertainty.

The package holds univariate and multivariate distributions, the Gaussian copula that correlates
univariate ones, and named inputs with a joint distribution; importing it fills the catalogue.

It knows arrays and the catalogue only. Parameters, error functions and effects stand on it, and so
does the propagation of uncertainty.
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
