"""kinematics.csv: declared and corrected Denavit-Hartenberg rows, base and tool of an arm.

Source: the constant part of the errors of the identified model, which is their mean over the
measured positions (`geometry.kinematics`).
Sign: values replace those of the control; correction = corrected - declared.
None where compensation does not reduce the error (`Closure.no_gain`), unless asked for.
Units: mm and deg, as the rows state. U is the expanded uncertainty (k = 2).
"""

import math

from ...geometry.kinematics import Number, corrected_kinematics
from .base import FORMATS, Format, Results, csv_text, number

_HEADER = "convention,place,name,declared,corrected,correction,U,unit"
_UNITS = {"m": ("mm", 1e3), "rad": ("deg", math.degrees(1.0))}


@FORMATS.register
class KinematicsCsv(Format):
    """Rows of an arm, one number per line; source, sign rule and units as in the docstring of this
    file.

    ``standard``: T = Rz(theta + q) Tz(d) Tx(a) Rx(alpha) Ry(beta); ``modified``: T = Rx(alpha)
    Tx(a) Ry(beta) Rz(theta + q) Tz(d). beta is zero except between nearly parallel axes, where d
    keeps its declared value. The base is the pose of the arm's base in the frame of the instrument
    (R = Rx Ry Rz), tool points are in the frame of the flange. The lines ``not in the table`` state
    the displacement of the tool point (rms and largest over the measured positions) by beta, where
    a control has four numbers per joint, and by what varies of the errors.
    """

    file = "kinematics.csv"
    summary = "corrected Denavit-Hartenberg rows, base and tool of the arm"

    def text(self, results: Results) -> str | None:
        chain = results.closure.after.model.chain
        if not chain.arm or chain.workpiece_side or results.closure.after.measurement.plan.sets:
            return None
        if results.closure.no_gain and not results.anyway:
            return None
        found = corrected_kinematics(results.closure.after)
        rows = [[*_HEADER.split(",")]]
        for convention, numbers in (("standard", found.numbers), ("modified", found.modified)):
            rows += [_row(convention, one) for one in numbers]
        for name, rms, largest in (
            ("beta", found.lost_rms, found.lost_max),
            ("errors that vary", found.varying_rms, found.varying_max),
        ):
            for what, value in (("rms", rms), ("largest", largest)):
                cells = ["", "not in the table", f"{name}: {what}", "", number(1e6 * value)]
                rows.append([*cells, "", "", "um"])
        return csv_text(rows)


def _row(convention: str, one: Number) -> list[str]:
    unit, factor = _UNITS[one.unit]
    declared, value = factor * one.declared, factor * one.value
    cells = [number(declared), number(value), number(value - declared), number(2 * factor * one.u)]
    return [convention, one.place, one.name, *cells, unit]
