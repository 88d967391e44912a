"""Geometric errors of the machine from the family declared in ``[model.geometric]``."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import equinox as eqx
import numpy as np

from ..effects.geometric import ErrorMotion, GeometricErrors, LocationError, link_errors
from ..errors import StudyError
from ..instruments.base import Column
from ..machine.chain import Chain
from ..machine.error_functions import (
    Basis,
    Constant,
    Fourier,
    Matern,
    Together,
    unit_uniform,
)
from ..registry import nearest
from ..words import counted
from .csv_table import Table
from .folder import Folder
from .messages import listed, refusal
from .settings import FourierSettings, LinkSettings, SmoothSettings

_MICRO = 1e-6
_AMPLITUDES = ("a0", "a1", "b1", "c1", "b2", "c2")
_WAVES = ("n1", "n2")
_SQUARENESS = {"EC0Y": "XY", "EB0Z": "XZ", "EA0Z": "YZ"}
"""Location errors of ISO 230-1 by name: the two axes that are not square."""

_LARGEST, _SMALLEST = 5e4, 1e-6
"""Amplitudes, um or urad."""
_MOST_WAVES, _FEWEST_WAVES = 1000.0, 0.01
"""Half waves over the travel. Shorter ones lie between the points of any measurement; longer ones
are straight lines."""

_WHY_SIZES = "more than 5 cm or 50 mrad is no error of a machine but another geometry"
_WHY_WAVES = "more lie between the points of any measurement"

FAMILY_COLUMNS: tuple[Column, ...] = tuple(
    Column(name=name, low=0.0, high=_MOST_WAVES, why=_WHY_WAVES)
    if name in _WAVES
    else Column(name=name, low=0.0, high=_LARGEST, why=_WHY_SIZES)
    for name in ("a0", "a1", "n1", "b1", "c1", "n2", "b2", "c2")
)
"""Columns of the Fourier family's table. They hold half-widths and wave numbers, none negative."""


def error_motions(chain: Chain) -> tuple[str, ...]:
    """ISO 230-1 names of the six error motions of every axis: ``"EXX", "EYX", ..., "ECZ"``."""
    return tuple(f"E{c}{axis}" for axis in chain.axes for c in "XYZABC")


def squareness_errors(chain: Chain) -> tuple[str, ...]:
    """ISO 230-1 names of the squareness errors between the linear axes of the chain."""
    return tuple(name for name, pair in _SQUARENESS.items() if set(pair) <= set(chain.axes))


def location_errors(chain: Chain) -> tuple[str, ...]:
    """ISO 230-1 names of all location errors: squareness, two parallelism errors of every secondary
    linear axis (``"EA0W", "EB0W"``), then two positions and two directions of every rotary axis
    (``"EX0C", "EY0C", "EA0C", "EB0C"``).
    """
    across = {"U": "BC", "V": "AC", "W": "AB"}
    beside = [f"E{c}0{axis}" for axis in chain.axes for c in across.get(axis, "")]
    own = {"A": "YZBC", "B": "XZAC", "C": "XYAB"}
    turning = [joint.name for joint in chain.joints if joint.turns]
    return (
        *squareness_errors(chain),
        *beside,
        *(f"E{c}0{axis}" for axis in turning for c in own[axis]),
    )


def geometric_errors(settings: Any, chain: Chain, folder: Folder, file: str) -> GeometricErrors:
    """The geometric errors declared by a validated ``[model.geometric]``.

    `folder` holds the table of the family; `file` is the name of the study file in messages. Raises
    `StudyError` for a component that is missing, unknown or repeated, for a negative amplitude, for
    a wave number of zero, and for an axis without a declared travel.
    """
    if isinstance(settings, LinkSettings):
        return _links(settings, chain, file)
    _check_travel(chain, file)
    if isinstance(settings, SmoothSettings):
        return _smooth(settings, chain)
    assert isinstance(settings, FourierSettings)
    return _fourier(folder.table(settings.table, FAMILY_COLUMNS, labels=("component",)), chain)


def _links(settings: LinkSettings, chain: Chain, file: str) -> GeometricErrors:
    """Constant errors of every link, and error motions of prismatic joints along their travel."""
    for i, joint in enumerate(chain.joints):
        if not joint.turns and not np.isfinite(joint.travel).all():
            raise refusal(
                file,
                f"key machine.joint.{i}",
                "a prismatic joint without bounds",
                "low_mm and high_mm, the travel over which its error motions are declared",
                "add them",
            )
    sizes = settings.link_translation_um * _MICRO, settings.link_rotation_urad * _MICRO
    slides = (settings.slide_translation_um, settings.slide_rotation_urad)
    varying = [
        size if own is None else own * _MICRO for size, own in zip(sizes, slides, strict=True)
    ]
    errors = link_errors(chain, *sizes, *varying, smoothness=settings.slide_smoothness)
    motions = {motion.name: motion for motion in errors.motions}
    changed: dict[str, int] = {}
    for i, row in enumerate(settings.link):
        for key, joint in (("joint", row.joint), ("tie", row.tie)):
            if joint is not None and joint not in chain.axes:
                raise refusal(
                    file,
                    f"key model.geometric.link.{i}.{key}",
                    f"the unknown joint {joint!r}{nearest(joint, chain.axes)}",
                    f"one of {listed(chain.axes)}",
                    "correct the name",
                )
        for c in dict.fromkeys(row.components):
            name = f"E{c}{row.joint}"
            if name in changed:
                raise refusal(
                    file,
                    f"key model.geometric.link.{i}",
                    f"{name} again, first in link.{changed[name]}",
                    "every error in one row",
                    "remove it from the components of one of the rows",
                )
            changed[name] = i
            own = row.translation_um if c in "XYZ" else row.rotation_urad
            if row.fixed:
                motions.pop(name)
            elif row.tie is not None:
                motions[name] = _tied(motions, name, f"E{c}{row.tie}", i, file)
            elif own is not None:
                size = own * _MICRO
                law = unit_uniform() if row.bounded else None
                sigma = size / math.sqrt(3.0) if row.bounded else size
                motions[name] = _resized(motions[name], Constant(sigma, law))
    return GeometricErrors(motions=tuple(motions.values()))


def _resized(motion: ErrorMotion, constant: Constant) -> ErrorMotion:
    """An error of a link with another constant part."""
    basis = motion.basis
    if isinstance(basis, Together):
        if constant.law is None:
            return replace(motion, basis=Together((constant, *basis.parts[1:])))
        # The functions along the travel are normal: a bounded constant replaces both.
    return replace(motion, basis=constant)


def _tied(
    motions: Mapping[str, ErrorMotion], name: str, other: str, row: int, file: str
) -> ErrorMotion:
    """An error of a joint that is that of another joint."""
    wanted, same = motions.get(name), motions.get(other)
    wrong = ""
    if other == name:
        wrong = f"{name} tied to itself"
    elif same is None or wanted is None:
        wrong = f"{name} tied to {other}, which is fixed"
    elif same.tied:
        wrong = f"{name} tied to {other}, which is tied to {same.tied}"
    elif isinstance(wanted.basis, Together) or isinstance(same.basis, Together):
        wrong = f"{name} tied to {other}, one of which varies along a travel"
    if wrong or wanted is None or same is None:
        raise refusal(
            file,
            f"key model.geometric.link.{row}.tie",
            wrong,
            "the joint whose errors are the parameters, a revolute one like the joint itself",
            "name another joint, or remove the row",
        )
    return replace(wanted, basis=same.basis, tied=other)


def _smooth(settings: SmoothSettings, chain: Chain) -> GeometricErrors:
    sizes = {True: settings.translation_um * _MICRO, False: settings.rotation_urad * _MICRO}
    motions = []
    for axis in chain.axes:
        # The eigenfunctions are the expensive part, and all six motions of an axis share them.
        joint = chain.joint(axis)
        unit = Matern(joint.travel.tolist(), 1.0, settings.smoothness, joint.around)
        for c in "XYZABC":
            basis = eqx.tree_at(lambda b: b.sigma, unit, unit.sigma * sizes[c in "XYZ"])
            motions.append(_motion(f"E{c}{axis}", basis))
    place = settings.location_um or settings.translation_um
    locations = tuple(
        LocationError.of(
            chain, name, (place if name[1] in "XYZ" else settings.squareness_urad) * _MICRO
        )
        for name in location_errors(chain)
    )
    return GeometricErrors(motions=tuple(motions), locations=locations)


def _fourier(table: Table, chain: Chain) -> GeometricErrors:
    expected = (*error_motions(chain), *location_errors(chain))
    row_of = _rows_by_component(table, expected, chain.axes)
    _check_sizes(table)
    for wave in _WAVES:
        i = wave[1]
        used = (table[f"b{i}"] > 0) | (table[f"c{i}"] > 0)
        moves = np.array([c in error_motions(chain) for c in table["component"]])
        if (bad := used & moves & (table[wave] == 0)).any():
            row = int(np.argmax(bad))
            raise table.refusal(
                row,
                wave,
                f"0 with b{i} = {table[f'b{i}'][row]:g} and c{i} = {table[f'c{i}'][row]:g}",
                "a wave number above 0",
                f"give {wave}, or set b{i} and c{i} to 0",
            )
    motions = []
    for name in error_motions(chain):
        v = {k: float(table[k][row_of[name]]) for k in (*_AMPLITUDES, *_WAVES)}
        harmonics = [
            (v["n1"], v["b1"] * _MICRO, v["c1"] * _MICRO),
            (v["n2"], v["b2"] * _MICRO, v["c2"] * _MICRO),
        ]
        travel = chain.joint(name[2:]).travel.tolist()
        motions.append(
            _motion(name, Fourier(travel, v["a0"] * _MICRO, v["a1"] * _MICRO, harmonics))
        )
    locations = []
    for name in location_errors(chain):
        half_width = float(table["a0"][row_of[name]]) * _MICRO
        if half_width > 0:  # zero declares an error-free location
            sigma = half_width / math.sqrt(3.0)
            locations.append(LocationError.of(chain, name, sigma, unit_uniform()))
    return GeometricErrors(motions=tuple(motions), locations=tuple(locations))


def _check_sizes(table: Table) -> None:
    """Raise `StudyError` for an amplitude or wave number that is not zero but too small."""
    for name in (*_AMPLITUDES, *_WAVES):
        least, most = (_FEWEST_WAVES, _MOST_WAVES) if name in _WAVES else (_SMALLEST, _LARGEST)
        if (bad := (table[name] > 0.0) & (table[name] < least)).any():
            row = int(np.argmax(bad))
            raise table.refusal(
                row,
                name,
                f"{table[name][row]:g}",
                f"zero, or a number from {least:g} to {most:g}",
                "correct the value or its unit",
            )


def _motion(name: str, basis: Basis) -> ErrorMotion:
    return ErrorMotion(name, name[2:], basis)


def _rows_by_component(
    table: Table, expected: Sequence[str], axes: Sequence[str]
) -> dict[str, int]:
    row_of: dict[str, int] = {}
    for row, component in enumerate(table["component"]):
        name = str(component)
        if name not in expected:
            axis = name[2:] if len(name) == 3 else ""
            unknown = f"; the machine has no axis {axis!r}" if axis and axis not in axes else ""
            raise table.refusal(
                row,
                "component",
                f"the unknown component {name!r}{nearest(name, expected)}{unknown}",
                f"one of {listed(expected)}",
                "correct or remove the row",
            )
        if name in row_of:
            raise table.refusal(
                row,
                "component",
                f"{name} again, first in row {row_of[name] + 1}",
                "every component once",
                "remove one of the rows",
            )
        row_of[name] = row
    missing = [name for name in expected if name not in row_of]
    if missing:
        raise _missing(table, missing, len(expected))
    return row_of


def _missing(table: Table, missing: Sequence[str], count: int) -> StudyError:
    return refusal(
        table.name,
        "column component",
        f"{counted(table.rows, 'row')} without {listed(missing)}",
        f"all {count} error motions and location errors of the machine's axes",
        "add the missing rows, with amplitudes of 0 for errors that are known to be zero",
    )


def _check_travel(chain: Chain, file: str) -> None:
    for joint in chain.joints:
        if not np.isfinite(joint.travel).all():
            raise refusal(
                file,
                f"key machine.rotary.{joint.name}.travel_deg"
                if joint.turns
                else f"key machine.travel_mm.{joint.name}",
                "nothing",
                "the lowest and highest position of the axis, over which [model.geometric] is "
                "declared",
                "add it, such as travel_deg = [0, 360]"
                if joint.turns
                else f"add it, such as {joint.name} = [0, 1000]",
            )
