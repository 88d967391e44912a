"""Measurements designed before they are made: what they will leave uncertain, and its gradient."""

from .minimax import Minimax, minimax
from .posterior import covariance, curvature, expanded, information, jacobian, precision
from .rank import Rank, rank_of
from .weights import Weights, apportion, weigh

__all__ = [
    "Minimax",
    "Rank",
    "Weights",
    "apportion",
    "covariance",
    "curvature",
    "expanded",
    "information",
    "jacobian",
    "minimax",
    "precision",
    "rank_of",
    "weigh",
]
