"""What the beams see of the thirteen errors, and what assuming the other eight to be zero does.

The publication identifies six straightnesses, two positioning errors, two rolls and three
squarenesses, and takes the other eight error motions for zero. Where they are not, the thirteen
take up what the beams show of them:

    bias = J13^+ J8 theta8
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from ...basis import Legendre
from ...batch import prepare_batch
from ...chain import Chain, chain_from_string
from ...effects.geometric import ErrorMotion, GeometricErrors, LocationError
from ...instruments.laser_frame import LaserFrame, beam_path, laser_frame
from ...model import Model
from ...plan import Plan

CHAIN = "w b X Y Z t"
TRAVEL: Mapping[str, tuple[float, float]] = {"X": (0.0, 0.184), "Y": (0.0, 0.167), "Z": (0.0, 0.35)}
"""Of the demonstrator, m."""
STRAIGHTNESSES = ("EYX", "EZX", "EXY", "EZY", "EXZ", "EYZ")
POSITIONING = ("EXX", "EYY")
ROLLS = ("EAX", "EBY")
SQUARENESSES = ("EA0Z", "EB0Z", "EC0Y")
OTHERS = ("EZZ", "EBX", "ECX", "EAY", "ECY", "EAZ", "EBZ", "ECZ")
DEGREES: Mapping[str, tuple[int, ...]] = {
    **{name: (2, 3, 4) for name in STRAIGHTNESSES},
    **{name: (1,) for name in POSITIONING},
    **{name: (1, 2, 3, 4) for name in (*ROLLS, *OTHERS)},
}
"""Legendre degrees: a straightness has no slope, which is a squareness or the frame's pose, and
five beams meet two positions of X and of Y only, so that positioning errors have but a slope.
"""
_FREE = 1e-8
"""Singular value of columns of unit length below which a combination is not seen."""
_WIDE = 1e-3
"""Prior of the thirteen that leaves everything to the data, m or rad."""


@dataclass(frozen=True)
class Seen:
    """What one beam path sees."""

    columns: int
    """Parameters of the thirteen errors and of the frame's pose."""
    rank: int
    mixed: tuple[str, ...]
    """The thirteen that are part of a combination that no reading shows."""
    bias: dict[str, float]
    """Largest standard deviation along its axis that the other eight put on an error (um, urad)."""
    invisible: tuple[str, ...]
    """Those of the other eight that no reading shows."""


def frame_setup(
    path: str = "3d", lever_m: float = 0.0, sigma_m: float = 1e-6
) -> tuple[Chain, LaserFrame, Plan]:
    """The demonstrator with one of the named beam paths, and its 51 points."""
    chain = chain_from_string(CHAIN, TRAVEL)
    segments = beam_path(path, TRAVEL)
    instrument = laser_frame(segments, chain, sigma=sigma_m, lever=lever_m)
    position = 1e3 * np.concatenate([one.positions for one in segments])
    table = {f"{c}_mm": position[:, i] for i, c in enumerate("xyz")}
    table["segment"] = np.repeat([one.number for one in segments], [one.points for one in segments])
    return chain, instrument, instrument.plan(chain, table)


def errors(chain: Chain, names: tuple[str, ...], sigma: Mapping[str, float]) -> GeometricErrors:
    """Error motions and squarenesses by name, every coefficient with the size `sigma[name]` (m or
    rad).
    """
    motions = tuple(
        ErrorMotion(name, name[2], Legendre(TRAVEL[name[2]], DEGREES[name], sigma[name]))
        for name in names
        if name in DEGREES
    )
    locations = tuple(
        LocationError.of(chain, name, sigma[name]) for name in names if name in SQUARENESSES
    )
    return GeometricErrors(motions=motions, locations=locations)


def seen(
    path: str = "3d",
    lever_m: float = 0.0,
    translation_um: float = 10.0,
    rotation_urad: float = 10.0,
) -> Seen:
    """Rank and bias of a beam path; every coefficient of the other eight has the given size."""
    chain, instrument, plan = frame_setup(path, lever_m)
    thirteen = (*STRAIGHTNESSES, *POSITIONING, *ROLLS, *SQUARENESSES)
    nuisance = instrument.effects(plan)
    own = errors(chain, thirteen, dict.fromkeys(thirteen, _WIDE))
    fit = Model(chain, instrument, (own, *nuisance))
    sizes = {n: (translation_um if n[1] in "XYZ" else rotation_urad) * 1e-6 for n in OTHERS}
    other = Model(chain, instrument, (errors(chain, OTHERS, sizes),))
    names = [entry.parameter.name.split(".")[0] for entry in fit.entries]
    j, j8 = (np.asarray(prepare_batch(m, plan).jacobian) for m in (fit, other))
    norms = np.linalg.norm(j, axis=0)
    norms = np.where(norms > 0.0, norms, 1.0)
    _, sizes_j, vt = np.linalg.svd(j / norms, full_matrices=True)
    rank = int((sizes_j > _FREE).sum())
    free = np.abs(vt[rank:]).max(0) if rank < len(names) else np.zeros(len(names))
    inverse = np.linalg.pinv(j / norms, rcond=_FREE) / norms[:, None]
    put = inverse @ j8
    bias = {}
    for name in thirteen:
        rows = [i for i, own_name in enumerate(names) if own_name == name]
        bias[name] = float(_along(name, put[rows]).max()) * _WIDE / 1e-6
    shown = np.abs(j8).max(0) > 1e-9 * np.abs(j8).max()
    eight = [entry.parameter.name.split(".")[0] for entry in other.entries]
    return Seen(
        columns=len(names),
        rank=rank,
        mixed=tuple(dict.fromkeys(n for n, f in zip(names, free, strict=True) if f > 1e-3)),
        bias=bias,
        invisible=tuple(
            name
            for name in OTHERS
            if not any(s for own_name, s in zip(eight, shown, strict=True) if own_name == name)
        ),
    )


def _along(name: str, rows: Float[np.ndarray, "d e"]) -> Float[np.ndarray, " n"]:
    """Standard deviation of an error along its axis, its coefficients being `rows` times standard
    normal numbers.
    """
    if name in SQUARENESSES:
        return np.linalg.norm(rows, axis=1)
    low, high = TRAVEL[name[2]]
    family = Legendre((low, high), DEGREES[name], 1.0)
    functions = np.asarray(family.functions(np.linspace(low, high, 21)))  # type: ignore[arg-type]
    return np.linalg.norm(functions @ rows, axis=1)
