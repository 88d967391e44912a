"""Measurements designed before they are made: what they will leave uncertain, and its gradient."""

from .array_space import ArraySpace, Candidate, spread
from .average import Average, weigh_average
from .ball_array import (
    ArrayPoses,
    PoseInformation,
    Touches,
    array_curvature,
    balls_precision,
    pairs_precision,
    pose_information,
    touches,
)
from .exchange import Choice, exchange
from .minimax import Minimax, minimax
from .mismatch import Left, drawn_errors, expected_error, fitted_places
from .posterior import covariance, curvature, expanded, information, inverse, jacobian, precision
from .rank import Rank, rank_of
from .search import Found, search
from .volume import (
    Displacements,
    Gram,
    displacements,
    expected_rms,
    gram_for,
    volumetric_gram,
)
from .weights import Weights, apportion, weigh

__all__ = [
    "ArrayPoses",
    "ArraySpace",
    "Average",
    "Candidate",
    "Choice",
    "Displacements",
    "Found",
    "Gram",
    "Left",
    "Minimax",
    "PoseInformation",
    "Rank",
    "Touches",
    "Weights",
    "apportion",
    "array_curvature",
    "balls_precision",
    "covariance",
    "curvature",
    "displacements",
    "drawn_errors",
    "exchange",
    "expanded",
    "expected_error",
    "expected_rms",
    "gram_for",
    "information",
    "fitted_places",
    "inverse",
    "jacobian",
    "minimax",
    "pairs_precision",
    "pose_information",
    "precision",
    "rank_of",
    "search",
    "spread",
    "touches",
    "volumetric_gram",
    "weigh",
    "weigh_average",
]
