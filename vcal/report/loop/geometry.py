"""Sections of the page: identified geometry, noise, and the conventions of frames and signs."""

from collections.abc import Sequence

import numpy as np

from ...effects.thermal import REFERENCE_DEGC
from ...geometry.acceptance import GeometricTest
from ...geometry.error_motions import ErrorMotionTable
from ...identification.fit import POORLY_DETERMINED, Learnt
from ...loop.outcome.closure import Closure
from ...study.study import Study
from ...words import counted, plural
from ..html import text
from ..html.picture import Shown
from ..html.provenance import NAMES
from ..html.sheet import Section, Table

_DIFFERENT = 3.0
"""Number of standard uncertainties beyond which a scatter differs from the declared one."""
_INFORMATION = "information from the data"


def geometry(
    closure: Closure,
    study: Study,
    tables: Sequence[ErrorMotionTable],
    tests: Sequence[GeometricTest],
    shown: Shown,
) -> list[Section]:
    """What the data determine, location errors, deviations of ISO 230-1, error motions."""
    sections = [_determined(closure)]
    stated = (*text.STATED, _INFORMATION)
    locations = [_location(t) for t in tables if not len(t.position)]
    if locations:
        table = Table(("error", "axis", *stated), locations, "llrrrlr")
        sections.append(Section("Location errors", tables=(table,), minor=True))
    if tests:
        table = Table(("error", "deviation", *stated), [_test(t) for t in tests], "llrrrlr")
        sections.append(_deviations(study, table))
    motions = [_motion(t) for t in tables if len(t.position)]
    header = (
        "error", "axis", "lowest", "highest", "largest U (k = 2)", "unit", f"{_INFORMATION}, mean",
    )  # fmt: skip
    fold = "Error motions in numbers"
    if not closure.no_gain:
        fold += " (on a grid in compensation.csv)"
    folded = Table(header, motions, "llrrrlr", fold=fold)
    note = (
        "Information: 1 − variance after / variance before the measurement, both from noise and "
        "declared priors alone. 0 %: the value is that of the declared prior."
    )
    if any(one.others for one in closure.alternatives):
        note += (
            " u also includes what alternatives, or a description of the unexplained residual, "
            "predict."
        )
    drawn = shown.get("geometry", ())
    return [*sections, Section("Error motions", (), (), (folded,), drawn, note, minor=True)]


def _determined(closure: Closure) -> Section:
    after, title = closure.after, "Identified geometry"
    found = Learnt.of(after.entries, np.sqrt(after.precision), after.planned_covariance)
    if not found.directions:
        return Section(title)
    about = (
        f"Of {found.directions} independent directions in the parameters with a prior, the "
        f"measurement determines {found.determined} to better than half their prior variance and "
        f"leaves {found.unseen} practically at their prior."
    )
    fold = (
        f"{counted(len(found.hardly), 'parameter')} that "
        f"{plural(len(found.hardly), 'is', 'are')} poorly determined (less than 5 % of the "
        "information is from the data)"
    )
    hardly = [(", ".join(found.hardly),)] if found.hardly else []
    return Section(title, (about,), tables=(Table(("",), hardly, fold=fold),))


def _deviations(study: Study, table: Table) -> Section:
    rotary = _rotary(study)
    return Section(
        "Geometric deviations (ISO 230-1)",
        (
            "Deviations of the tool point's path from its least-squares line (ISO 230-1:2012, 3.4 "
            f"and 3.6){', seen from the workpiece' if rotary else ''}: one axis after the other "
            "moves over its travel, the others stand at mid-travel"
            f"{' and rotary axes at 0°' if rotary else ''}. Squareness is positive where the later "
            "axis is rotated in the positive sense from the earlier one. The values depend neither "
            "on the frame nor on how slopes are divided between parameters.",
        ),
        tables=(table,),
        note="Errors that depend on direction, temperature or time are not included. For a "
        "deviation with less than 5 % of its information from the data, only u is given; it is "
        "that of the declared priors.",
        minor=True,
    )


def _rotary(study: Study) -> bool:
    return not study.chain.arm and not study.chain.linear


def _location(table: ErrorMotionTable) -> tuple[str, ...]:
    cells = text.stated(float(table.value[0]), float(table.u[0]), table.unit)
    return (table.name, table.axis, *cells, text.percent(float(table.information[0])))


def _test(test: GeometricTest) -> tuple[str, ...]:
    value, *cells = text.stated(test.value, test.u, test.unit)
    if test.information < POORLY_DETERMINED:
        value = text.DASH  # the estimate of an unobserved deviation is that of its prior
    return (test.name, test.what, value, *cells, text.percent(test.information))


def _motion(table: ErrorMotionTable) -> tuple[str, ...]:
    """Range, largest uncertainty and mean information of an error motion."""
    largest = float(table.u.max())
    return (
        table.name,
        table.axis,
        text.rounded(float(table.value.min()), largest)[0],
        text.rounded(float(table.value.max()), largest)[0],
        text.rounded(0.0, text.COVERAGE * largest)[1],
        text.unit(table.unit),
        text.percent(float(table.information.mean())),
    )


def noise(closure: Closure, shown: Shown) -> Section:
    """Scatter of the residuals relative to the declared noise."""
    rows = [
        (part.name, text.number(part.factor), text.number(part.u, 2))
        for part in closure.noise_components
        if not np.isnan(part.u)
    ]
    words = _scatter(closure)
    different = _different(closure)
    if different and not closure.noise_uneven:
        words += (
            " Single kinds of reading deviate from it by more than three standard uncertainties: "
            f"{', '.join(different)} (relative to the declared noise; see the table)."
        )
    if (closure.after.clusters >= 0).any():
        words += (
            " The readings of one observation share errors that are not modelled; the search "
            "estimated their covariance from the residuals."
        )
    table = Table(("reading", "scatter / declared", "u"), rows, "lrr")
    return Section("Noise", (words,), tables=(table,), pictures=shown.get("noise", ()))


def _scatter(closure: Closure) -> str:
    scale = closure.noise_scale
    scales = [f"{n} {text.number(s)}" for n, s in closure.noise_scales.items() if n]
    if closure.noise_uneven:
        return (
            "The kinds of reading scatter differently relative to the declared noise: see the "
            "table. The search used the estimated scatter; so do the standard uncertainties after "
            "closing the loop, where it is larger than declared."
        )
    if scales:
        return (
            "The scatter of the residuals, relative to the declared noise of each data set, is: "
            f"{', '.join(scales)} (1: no significant difference). Where it is larger, the "
            "standard uncertainties after closing the loop are enlarged by it."
        )
    if scale == 1.0:
        together = "All readings taken together, the" if _different(closure) else "The"
        return (
            f"{together} scatter of the residuals agrees with the declared noise of the instrument."
        )
    return f"The scatter of the residuals is {text.number(scale)} times the declared noise; " + (
        "the standard uncertainties after closing the loop are enlarged by that factor."
        if scale > 1.0
        else "uncertainties are stated for the declared, larger noise."
    )


def _different(closure: Closure) -> list[str]:
    """Kinds of reading that do not scatter as declared, though all readings together do."""
    found = []
    for part in closure.noise_components:
        whole = closure.noise_scales.get(part.name.partition(" ")[0], closure.noise_scale)
        if whole == 1.0 and abs(part.factor - 1.0) > _DIFFERENT * part.u:
            found.append(f"{part.name} {text.number(part.factor)} ± {text.number(part.u, 2)}")
    return found


def _rows(study: Study) -> str:
    """The order of link, joint and error in the declared rows of an arm."""
    return {
        "standard DH": "Joints follow standard Denavit-Hartenberg rows: motion of the joint about "
        "or along z, then the error twist, then the link (d along z, a along x, alpha about x)",
        "modified DH": "Joints follow modified Denavit-Hartenberg rows (Craig): the link (a along "
        "x, alpha about x), motion of the joint about or along z, then the error twist, then d "
        "along z",
    }.get(
        study.chain.text,
        f"Joints follow {study.chain.text}: the origin of the joint, motion about or along its "
        "axis, then the error twist",
    )


def conventions(study: Study) -> Section:
    """Frames, signs and units of all numbers in the report."""
    rotary = _rotary(study)
    if study.chain.arm:
        points = [
            "Right-handed frames. Error = actual − nominal; a compensation subtracts it.",
            f"{_rows(study)}. The error twist has the names E, component X, Y, Z, A, B, C, joint: "
            "ECJ2 is an error of the angle of joint 2. The pose of the base in the instrument's "
            "frame and the points on the tool are unknown and fitted, unless they are declared.",
            "Residuals of the tool point are given in the frame of the tool.",
        ]
    else:
        points = [
            NAMES,
            "EXY is the straightness error of Y along X. EC0Y, EB0Z, EA0Z tilt the direction of "
            "travel, so that y moves by (−EC0Y y, y, 0) and z by (EB0Z z, −EA0Z z, z).",
            f"{'A linear axis' if rotary else 'An axis'} translates by its position plus its error "
            "translation, then rotates by its error rotation about its own moving frame: levers "
            "extend from there to the tool point. Errors refer to the axis's own frame; an axis "
            "that carries the workpiece moves against its own command.",
        ]
    if rotary:
        points.append(
            "A rotary axis is displaced by its error translation, tilted by its error rotation "
            "about its reference point (at_mm), and rotates about the axis that is there; its "
            "errors refer to the frame of what carries it and do not rotate with it. Location "
            "errors of an axis C: EX0C and EY0C are its position, EA0C and EB0C its direction; "
            "likewise for A and B."
        )
    points += [
        "Signs of effects: as parameters of the joint's own frame. A positive backlash is a lead: "
        "+ size/2 where the last travel was in the positive direction. Temperatures count from "
        f"{_zero(study)}.",
        "Units: mm and degrees for positions, µm and µrad for errors, °C and K for temperatures, "
        "as each column and table states. rms of points: root of the mean squared length of the "
        "three-dimensional error.",
        "u is a standard uncertainty, from the posterior covariance of the fit (noise and declared "
        "priors). In the error at the check points, the error motions and the error field it "
        "includes the choice of the model: what alternatives, and a description of the unexplained "
        "residual, predict. Elsewhere it does not. U = k u with k = 2, about 95 % coverage for a "
        "normal distribution.",
    ]
    return Section("Frames, signs and units", points=tuple(points))


def _zero(study: Study) -> str:
    """The temperature from which temperatures count, by data set where it differs."""
    zeros = {
        one.name: f"{REFERENCE_DEGC + one.instrument.temperature_offset_K:g} °C"
        for one in study.sets
    }
    if len({*zeros.values()}) == 1:
        return next(iter(zeros.values()))
    return ", ".join(f"{zero} in {name}" for name, zero in zeros.items())
