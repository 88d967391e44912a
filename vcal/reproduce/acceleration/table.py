"""Printed numbers beside those that came out."""

import math

from ...report.html.text import number
from ..registry import Row
from .results import Results, element, exz_of_the_circle, single_circle_U
from .setting import (
    ACTUAL_PEAK,
    DEVICE_U_UM,
    MEASURED,
    MEASURED_M_S2,
    MOVE_RATIO,
    MOVE_UM,
    RADIUS_M,
    SET_PEAK,
    SIMULATED,
    SIMULATED_M_S2,
    circle,
    move,
)

_E = "um s2/m"
"""Of all elements."""


def table(results: Results) -> list[Row]:
    """All printed numbers, and those that belong beside them."""
    r = results
    simulated, measured = exz_of_the_circle(r)
    u = 2.0 * element(r.joint.u, "XZ")
    found_u = 2e6 * element(r.found.matrix_u, "XZ")
    here, there, true = r.catalogue.move, r.identified.move, r.true.move
    fastest = circle("ZX", 5.0)
    return [
        Row("frequency of a circle of 2 mm at 5 m/s²", 8.0, fastest.omega / math.tau, "Hz"),
        Row("EXZ, measured, circle in YZ", MEASURED, measured, _E,
            f"at {MEASURED_M_S2:g} m/s²; U = {single_circle_U():.2f} by the device; the machine "
            "that is measured here was chosen to have the printed value"),
        Row("EXZ, measured, all circles at once", MEASURED, element(r.joint.matrix, "XZ"), _E,
            f"U = {u:.3f}, with U = {DEVICE_U_UM:g} µm of the R-test"),
        Row("EXZ, simulated, circle in YZ", SIMULATED, simulated, _E,
            f"at {SIMULATED_M_S2:g} m/s²; the catalogue's machine was chosen to have the printed "
            "value"),
        Row("EXZ, identified from the catalogue on", MEASURED, element(r.identified.matrix, "XZ"),
            _E, f"U = {found_u:.3f}; put in {number(element(r.true.matrix, 'XZ'), 5)}"),
        Row("measured over simulated", MEASURED / SIMULATED,
            element(r.joint.matrix, "XZ") / simulated, "1", "“about the factor of 2 to 3”"),
        Row("measured over identified", None,
            element(r.joint.matrix, "XZ") / element(r.identified.matrix, "XZ"), "1"),
        Row("angular velocity at 4.7 m/s²", None, circle("YZ", SIMULATED_M_S2).omega, "rad/s"),
        Row("positioning, peak of the set velocity", None, move().peak_velocity, "m/s",
            "30 m/min is not reached"),
        Row("positioning, peak of the set acceleration", SET_PEAK, here.set_peak, "m/s2",
            "not printed, read from the figure; (S J²/2)^(1/3), limited by jerk alone"),
        Row("positioning, peak of the actual acceleration", ACTUAL_PEAK, here.peak, "m/s2"),
        Row("positioning, cross-talk at that peak", MOVE_UM, abs(here.at_peak_um), "um",
            "catalogue's machine"),
        Row("positioning, cross-talk over acceleration at the peak", MOVE_RATIO, here.ratio, _E,
            f"printed 3.7 µm over 7.9 m/s² is {number(-MOVE_UM / ACTUAL_PEAK)}; the drop from "
            f"{number(SIMULATED)} on the circle is not reproduced"),
        Row("the same over that of the circle", MOVE_RATIO / SIMULATED, here.ratio / simulated,
            "1"),
        Row("positioning, least squares over the whole move", None, here.fitted, _E),
        Row("positioning, cross-talk at the peak, machine that is measured", None,
            abs(true.at_peak_um), "um"),
        Row("the same as the identified machine foretells it", None, abs(there.at_peak_um), "um",
            "from circles alone"),
        Row("radius of the circles", 2.0, 1e3 * RADIUS_M, "mm"),
    ]  # fmt: skip
