"""Uncertainty by the GUM, by Monte Carlo, and the comparison of both (JCGM 100, 101 and 102).

`propagate` and `propagate_distributions` take a measurement function; `monte_carlo` and
`linearised` take a virtual calibration, that is, a simulated measurement with its identification;
`two_level` combines both;
`compare` validates the first method by the second. `calibration_curve` fits a curve to points with
uncertainty; `required_u` and `sweep` ask for the uncertainty of an input. Uses `identification`,
`geometry` and what lies below; knows nothing of `loop` and `design`. `study`, `report`, `reproduce`
and `cli` stand on it.
"""

from .adaptive import Adaptive, Precision, numerical_tolerance
from .budget import Budget
from .campaign import Campaign, monte_carlo, virtual_pair
from .comparison import Attained, Comparison, attained_coverage, compare
from .curves import CalibrationCurve, Prediction, calibration_curve
from .decisions import (
    Conformity,
    GlobalRisks,
    Tolerance,
    conformity,
    global_risks,
    guard_band_for_risk,
)
from .ensemble import Ensemble, FieldResult
from .functions import propagate_distributions
from .joint import Joint, joint_outputs
from .levels import TwoLevel, two_level
from .linear import Linearised, linearised
from .mismatch import Left, drawn_errors, expected_error, fitted_places
from .outputs import Field, Output
from .programs import Programs
from .propagation import propagate
from .quantities import (
    ErrorMotionErrors,
    LineErrors,
    Measure,
    ParameterErrors,
    Quantity,
    VolumetricErrors,
)
from .regions import Box, Ellipsoid, coverage_box, coverage_ellipsoid, normal_box, normal_ellipsoid
from .reverse import Required, Sweep, required_u, sweep
from .saved import load_budget, save_budget
from .streaming import stream
from .table import budget_table, comparison_table, result_line

__all__ = [
    "Adaptive",
    "Attained",
    "Box",
    "Budget",
    "CalibrationCurve",
    "Campaign",
    "Comparison",
    "Conformity",
    "Ellipsoid",
    "Ensemble",
    "ErrorMotionErrors",
    "Field",
    "FieldResult",
    "GlobalRisks",
    "Joint",
    "Left",
    "LineErrors",
    "Linearised",
    "Measure",
    "Output",
    "ParameterErrors",
    "Precision",
    "Prediction",
    "Programs",
    "Quantity",
    "Tolerance",
    "Required",
    "Sweep",
    "TwoLevel",
    "VolumetricErrors",
    "attained_coverage",
    "budget_table",
    "calibration_curve",
    "compare",
    "conformity",
    "comparison_table",
    "coverage_box",
    "coverage_ellipsoid",
    "drawn_errors",
    "expected_error",
    "fitted_places",
    "global_risks",
    "guard_band_for_risk",
    "joint_outputs",
    "linearised",
    "load_budget",
    "monte_carlo",
    "normal_box",
    "normal_ellipsoid",
    "numerical_tolerance",
    "propagate",
    "propagate_distributions",
    "required_u",
    "result_line",
    "save_budget",
    "stream",
    "sweep",
    "two_level",
    "virtual_pair",
]
