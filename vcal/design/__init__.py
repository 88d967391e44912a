"""Design of measurements: the posterior uncertainty of a plan, its gradient, and better plans.

`spaces` holds the plans that may be searched, a file per instrument; `criteria` the numbers to
minimise; `optimise` searches a plan, `plan_next` a further measurement; `exchange`, `weigh` and
`minimax` solve the selection problems behind published designs. Uses `identification`, `geometry`
and what lies below; knows nothing of `loop` and `uncertainty`. `study`, `report`, `reproduce` and
`cli` stand on it.
"""

from ..geometry.volumetric import (
    Displacements,
    Gram,
    displacements,
    expected_rms,
    gram_for,
    volumetric_gram,
)
from ..identification.posterior import (
    covariance,
    curvature,
    expanded,
    information,
    inverse,
    jacobian,
    precision,
)
from ..identification.rank import Rank, flat_rank, rank_of
from .average import Average, weigh_average
from .criteria import CRITERIA, Criterion, Judged
from .minimax_design import Minimax, minimax
from .multistart import Found, search
from .next_measurement import NextMeasurement, plan_next
from .optimiser import Designed, Task, optimise
from .plan_space import DesignSettings, PlanSpace, Subject
from .point_exchange import Choice, exchange
from .separation import Rival, Separation
from .spaces import SPACES
from .spaces.array_bounds import ArraySpace, Candidate, spread
from .spaces.ball_information import (
    ArrayPoses,
    PoseInformation,
    Touches,
    array_curvature,
    balls_precision,
    pairs_precision,
    pose_information,
    touches,
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
    "NextMeasurement",
    "Found",
    "Gram",
    "Judged",
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
    "exchange",
    "expanded",
    "expected_rms",
    "flat_rank",
    "plan_next",
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
