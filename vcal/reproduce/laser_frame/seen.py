"""What the beams see of the thirteen errors, and what assuming the other eight to be zero does.

The publication identifies six straightnesses, two positioning errors, two rolls and three
squarenesses, and takes the other eight error motions for zero. Where they are not, the thirteen
take up what the beams show of them:

    bias = J13^+ J8 theta8
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from ...design import jacobian, rank_of
from ...identification.rank import FREE
from ...machine.error_functions import Legendre
from ...model.forward import Model
from .setting import (
    DEGREES,
    OTHERS,
    ROTATION_URAD,
    SQUARENESSES,
    THIRTEEN,
    TRANSLATION_UM,
    TRAVEL,
    WIDE_M,
    errors,
    frame_setup,
    sizes,
)


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


def seen(
    path: str = "3d",
    lever_m: float = 0.0,
    translation_um: float = TRANSLATION_UM,
    rotation_urad: float = ROTATION_URAD,
) -> Seen:
    """Rank and bias of a beam path; every coefficient of the other eight has the given size."""
    chain, instrument, plan = frame_setup(path, lever_m)
    nuisance = instrument.effects(plan)
    own = errors(chain, THIRTEEN, dict.fromkeys(THIRTEEN, WIDE_M))
    fit = Model(chain, instrument, (own, *nuisance))
    others = errors(chain, OTHERS, sizes(translation_um, rotation_urad))
    other = Model(chain, instrument, (others,))
    names = [entry.parameter.name.split(".")[0] for entry in fit.entries]
    rank = rank_of(fit, plan)
    j, j8 = (np.asarray(jacobian(m, plan)).reshape(2 * plan.rows, -1) for m in (fit, other))
    norms = np.linalg.norm(j, axis=0)
    norms = np.where(norms > 0.0, norms, 1.0)
    inverse = np.linalg.pinv(j / norms, rcond=FREE) / norms[:, None]
    put = inverse @ j8
    bias = {}
    for name in THIRTEEN:
        rows = [i for i, own_name in enumerate(names) if own_name == name]
        bias[name] = float(_along(name, put[rows]).max()) * WIDE_M / 1e-6
    shown = np.abs(j8).max(0) > 1e-9 * np.abs(j8).max()
    eight = [entry.parameter.name.split(".")[0] for entry in other.entries]
    return Seen(
        columns=rank.columns,
        rank=rank.rank,
        mixed=tuple(dict.fromkeys(names[i] for i in rank.mixed)),
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
