"""Measurements designed before they are made: what they will leave uncertain, and its gradient."""

from .minimax import Minimax, minimax
from .posterior import covariance, curvature, expanded, information, jacobian, precision
from .weights import Weights, apportion, weigh

__all__ = [
    "Minimax",
    "Weights",
    "apportion",
    "covariance",
    "curvature",
    "expanded",
    "information",
    "jacobian",
    "minimax",
    "precision",
    "weigh",
]
