"""Distributions of quantities (JCGM 101, 6.4): priors of parameters, inputs of uncertainty.

The package holds univariate and multivariate distributions, those that readings and certificates
are assigned, the Gaussian copula that correlates univariate ones, and named inputs with a joint
distribution; importing it fills the catalogue.

It knows arrays and the catalogue only. Parameters, error functions and effects stand on it, and so
does the propagation of uncertainty.
"""

from .base import Distribution, Multivariate, Univariate
from .bounded import Arcsine, Trapezoidal, Triangular, Uniform
from .copula import GaussianCopula
from .empirical import Empirical
from .evaluated import (
    Anova,
    Certificate,
    Groups,
    PooledDeviation,
    Repeats,
    Series,
    degrees_of_freedom,
    pooled_deviation,
)
from .exponential import Laplace, Weibull
from .inexact import CurvilinearTrapezoid
from .inputs import Inputs
from .multivariate import MultivariateNormal, MultivariateT
from .normal import Normal, StudentT
from .poisson import Poisson
from .registry import CATALOGUE, distribution, distribution_class
from .scaling import Rescaled, rescaled
from .shaped import Beta, Gamma, LogNormal

__all__ = [
    "CATALOGUE",
    "Anova",
    "Arcsine",
    "Beta",
    "Certificate",
    "CurvilinearTrapezoid",
    "Distribution",
    "Empirical",
    "Gamma",
    "GaussianCopula",
    "Groups",
    "Inputs",
    "Laplace",
    "LogNormal",
    "Multivariate",
    "MultivariateNormal",
    "MultivariateT",
    "Normal",
    "Poisson",
    "PooledDeviation",
    "Repeats",
    "Rescaled",
    "Series",
    "StudentT",
    "Trapezoidal",
    "Triangular",
    "Uniform",
    "Univariate",
    "Weibull",
    "degrees_of_freedom",
    "distribution",
    "distribution_class",
    "pooled_deviation",
    "rescaled",
]
