"""Columns of conditions that a table may have, with the bounds of their numbers and the reasons."""

import math
import re
from dataclasses import dataclass

from ..instruments.base import Column
from ..instruments.conditions import GROUPS


@dataclass(frozen=True)
class Condition:
    """Columns of one kind."""

    pattern: str
    """Regular expression of their names."""
    name: str
    """Their names in the documentation."""
    low: float
    high: float
    why: str
    """Why no number is beyond the bounds."""
    sparse: bool = False
    """Whether a column in which hardly any cell is a number counts as absent."""

    def column(self, name: str) -> Column:
        """The declaration of a column of that name."""
        return Column(name=name, low=self.low, high=self.high, why=self.why, sparse=self.sparse)


CONDITIONS: tuple[Condition, ...] = (
    Condition(
        r"\w+_degC", "`T_x_degC`, `..._degC`", -50.0, 150.0,
        "no machine is measured at a temperature beyond", sparse=True,
    ),
    Condition(r"t_s", "`t_s`", -1e10, 1e10, "300 years; seconds since 1970 have ten digits"),
    Condition(r"dir_\w+", "`dir_x`, `dir_c`, ...", -1.0, 1.0, "it is the sign of the last move"),
    Condition(
        r"(\w+_)?(payload|load|mass|weight)\w*_kg", "`payload_kg`, `..._load_kg`, `mass_..._kg`",
        0.0, 1e6, "a load is not negative, and no machine carries 1000 t",
    ),
    Condition(
        r"(\w+_)?(path|distance|travelled)\w*_(mm|m|km)", "`path_mm`, `distance_m`, ...",
        0.0, math.inf, "a length of path is not negative",
    ),
    Condition(
        r"since_\w+_(mm|deg)", "`since_x_mm`, `since_c_deg`", 0.0, math.inf,
        "a distance since the last reversal is not negative",
    ),
    Condition(r"speed_rpm", "`speed_rpm`", -1e6, 1e6, "no spindle turns faster"),
    Condition(r"approach_rad", "`approach_rad`", -6.2832, 6.2832, "it is within one turn"),
    Condition(
        r"T_gradient_\w+", "`T_gradient_K_per_m`", -1e3, 1e3,
        "1000 K over a metre is no temperature of a machine",
    ),
    Condition(r"v_[a-c]_rad_s", "`v_c_rad_s`", -1e5, 1e5, "no axis turns faster"),
    Condition(r"a_[a-c]_rad_s2", "`a_c_rad_s2`", -1e7, 1e7, "no axis turns up faster"),
    Condition(r"v_\w+_m_s", "`v_x_m_s`", -100.0, 100.0, "no axis moves faster than 6000 m/min"),
    Condition(r"a_\w+_m_s2", "`a_x_m_s2`", -1e4, 1e4, "no axis accelerates with 1000 g"),
    Condition(r"q\d+_(cmd|read)_deg", "`q1_cmd_deg`, `q1_read_deg`", -720.0, 720.0,
              "no joint of an arm makes more than two turns"),
    Condition(r"q\d+_(cmd|read)_mm", "`q1_cmd_mm`, `q1_read_mm`", -1e5, 1e5,
              "no joint of an arm slides 100 m"),
)  # fmt: skip
"""The first kind that a name matches counts."""
_PATTERNS = tuple((re.compile(one.pattern), one) for one in CONDITIONS)


def condition(name: str) -> Column | None:
    """The declaration of an optional column; None for a column without one."""
    if name in GROUPS:
        return Column(name=name, low=0, integer=True, why="an index counts from 0")
    for pattern, one in _PATTERNS:
        if pattern.fullmatch(name):
            return one.column(name)
    return None
