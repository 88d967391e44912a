"""``[data] must_see``: errors that the data have to identify without a prior."""

from collections.abc import Mapping, Sequence

import numpy as np

from ..effects.base import across
from ..effects.geometric import ErrorMotion, GeometricErrors, LocationError
from ..identification.rank import rank_of
from ..instruments.base import Instrument
from ..machine.chain import Chain
from ..machine.error_functions import Legendre
from ..machine.plan import Plan
from ..model.forward import Model
from ..registry import nearest
from .messages import FEW, listed, refusal

_HIGHEST = 12
_SIZE = 1e-5
LINES = dict(zip("XYZABC", ("XA", "YB", "ZC") * 2, strict=True))
"""Axes along or about the direction of a component, which have no such location error."""


def check_identifiable(
    wanted: Mapping[str, int],
    chain: Chain,
    instrument: Instrument,
    plan: Plan,
    file: str,
    key: str = "data.must_see",
) -> None:
    """Raise `StudyError` where the Jacobian of the wanted errors has no full column rank.

    The unknown poses of the instrument are identified together with the errors. `wanted` maps an
    error motion to its highest Legendre degree and a location error to 0; `key` is its place in the
    study file.
    """
    if not wanted:
        return
    lowest = check_wanted(wanted, chain, file, key)
    model = Model(
        chain,
        instrument,
        (
            GeometricErrors(
                motions=tuple(
                    error_motion(plan, name, range(lowest[name], degree + 1))
                    for name, degree in wanted.items()
                    if lowest[name]
                ),
                locations=tuple(
                    LocationError.of(chain, name, _SIZE) for name in wanted if not lowest[name]
                ),
            ),
            # A quantity with a prior of its own, such as a calibrated ball, counts as known.
            *(effect for effect in instrument.effects(plan) if effect.kind == "nuisance"),
        ),
    )
    found = rank_of(model, plan)
    if found.rank < found.columns:
        parts = [model.entries[i].parameter.name.split(".")[0] for i in found.mixed]
        mixed = [name for name in dict.fromkeys(parts) if name in wanted]
        raise refusal(
            file,
            f"key {key}",
            f"{plan.rows} points that identify {found.rank} of {found.columns} parameters; "
            f"{listed(mixed, FEW)} {'is' if len(mixed) == 1 else 'are'} not identified",
            "points that identify all of them",
            "measure more or other positions, or remove errors or degrees from this key",
        )


def check_wanted(wanted: Mapping[str, int], chain: Chain, file: str, key: str) -> dict[str, int]:
    """The lowest degree of every error of the machine; 0 for location errors.

    Degrees below it belong to the pose of the artefact or of the station. Raises `StudyError` for
    an error or a degree that does not exist.
    """
    linear = [joint.name for joint in chain.joints if joint.kind == "prismatic"]
    turning = [joint.name for joint in chain.joints if joint.kind == "rotary"]
    located = [
        f"E{c}0{axis}"
        for axis, components in (*((a, "ABC") for a in linear), *((a, "XYZABC") for a in turning))
        for c in components
        if axis not in LINES[c]
    ]
    motions = [f"E{c}{axis}" for axis in chain.axes for c in "XYZABC"]
    straight = {port for axis in linear for port in across(chain, axis)}
    lowest = {n: 2 if n in straight else 1 for n in motions} | dict.fromkeys(located, 0)
    for name, degree in wanted.items():
        _check_key(name, degree, lowest, file, key)
    return lowest


def _check_key(name: str, degree: int, lowest: Mapping[str, int], file: str, table: str) -> None:
    key = f"key {table}.{name}"
    if name not in lowest:
        raise refusal(
            file,
            key,
            f"the unknown error {name!r}{nearest(name, lowest)}",
            f"an error motion such as {next(iter(lowest))}, or a location error such as "
            f"{next(n for n, low in lowest.items() if not low)}",
            "correct or remove the key",
        )
    low = lowest[name]
    high = _HIGHEST if low else 0
    if not low <= degree <= high:
        raise refusal(
            file,
            key,
            f"the degree {degree}",
            f"a degree from {low} to {high}" if low else "0, as a location error has no degree",
            "correct it",
        )


def error_motion(plan: Plan, name: str, degrees: Sequence[int]) -> ErrorMotion:
    """An error motion of some Legendre degrees over the measured range of its axis."""
    axis = name[2:]
    x = np.asarray(plan.x(axis))
    # On an axis that did not move, all polynomials are constants, which no reading identifies.
    ends = float(x.min()), max(float(x.max()), float(x.min()) + 1e-9)
    return ErrorMotion(name, axis, Legendre(ends, tuple(degrees), _SIZE))
