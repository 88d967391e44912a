from .changing import changing_sizes
from .declared_machine import axis_label, machine_views
from .effect_signature import Signature, signature, signatures
from .labels import pretty_unit
from .loop_search import minus_log10_p, search
from .motions import error_motions
from .pieces import Piece, Pieces, cut, smallest_text
from .residuals import before_after, normal_plot, unexplained, unexplained_views
from .style import png, svg
from .sweeps import sweep_view
from .views import View, column_of, effect_view, place_of, values_of
from .volumetric_errors import (
    check_errors,
    check_points,
    error_over_time,
    field,
)

__all__ = [
    "Piece",
    "Pieces",
    "Signature",
    "View",
    "axis_label",
    "before_after",
    "changing_sizes",
    "check_errors",
    "check_points",
    "column_of",
    "cut",
    "effect_view",
    "error_motions",
    "error_over_time",
    "field",
    "machine_views",
    "minus_log10_p",
    "normal_plot",
    "place_of",
    "png",
    "pretty_unit",
    "search",
    "signature",
    "signatures",
    "smallest_text",
    "svg",
    "sweep_view",
    "unexplained",
    "unexplained_views",
    "values_of",
]
