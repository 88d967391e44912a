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
from .criteria import CRITERIA, Criterion, Judged
from .exchange import Choice, exchange
from .following import Following, follow
from .minimax import Minimax, minimax
from .mismatch import Left, drawn_errors, expected_error, fitted_places
from .optimise import Designed, Task, optimise
from .plan_space import DesignSettings, PlanSpace, Subject
from .posterior import covariance, curvature, expanded, information, inverse, jacobian, precision
from .rank import Rank, flat_rank, rank_of
from .search import Found, search
from .separation import Rival, Separation
from .spaces import SPACES
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
    "CRITERIA",
    "SPACES",
    "ArrayPoses",
    "ArraySpace",
    "Average",
    "Candidate",
    "Choice",
    "Criterion",
    "DesignSettings",
    "Designed",
    "Displacements",
    "Following",
    "Found",
    "Gram",
    "Judged",
    "Left",
    "Minimax",
    "PlanSpace",
    "PoseInformation",
    "Rank",
    "Rival",
    "Separation",
    "Subject",
    "Task",
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
    "fitted_places",
    "flat_rank",
    "follow",
    "gram_for",
    "information",
    "inverse",
    "jacobian",
    "minimax",
    "optimise",
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
