"""Natural frequencies, damping ratios and mode shapes of a machine."""

from typing import NamedTuple

import numpy as np
import scipy.linalg
from jaxtyping import Float

from ..numerics.eigen import eigh
from .structure import Structure

_RIGID = 1e-6
"""Share of the largest natural frequency below which a mode is a rigid-body mode."""

_HELD = 1e-12
"""Share of the square of the largest frequency above which a body is supported: well above
rounding, and below the value for a heavy body on an air spring next to a light one on a stiff
spring.
"""


class Modes(NamedTuple):
    """Modes in ascending order, without rigid-body modes unless requested."""

    hz: Float[np.ndarray, " m"]
    """Undamped natural frequency."""
    damping: Float[np.ndarray, " m"]
    """Modal damping ratio, phi' D phi / (2 omega) for phi' M phi = 1."""
    shapes: Float[np.ndarray, "n m"]
    """Mass-normalised mode shapes, one column each."""


def modes(structure: Structure, *, rigid: bool = False) -> Modes:
    """Solve K phi = omega^2 M phi; with `rigid` including modes of frequency zero."""
    M, D, K = (np.asarray(m) for m in (structure.mass, structure.damping, structure.stiffness))
    squares, shapes = scipy.linalg.eigh(K, M)
    omega = np.sqrt(np.maximum(squares, 0.0))
    kept = np.full(len(omega), True) if rigid else omega > _RIGID * omega.max()
    omega, shapes = omega[kept], shapes[:, kept]
    modal = np.einsum("nm,nk,km->m", shapes, D, shapes)
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = np.where(omega > 0.0, modal / (2.0 * omega), np.nan)
    return Modes(omega / (2.0 * np.pi), ratio, shapes)


def check_supported(structure: Structure, names: list[str]) -> None:
    """Raise `ValueError` where a body can move without a spring or drive that holds it.

    `names` are those of the bodies, in the order of the coordinates.
    """
    # Drives hold their axes under control; a stiffness stands in for them here.
    K, M = np.asarray(structure.stiffness), np.asarray(structure.mass)
    B = np.asarray(structure.force)
    lent = np.trace(K) / len(K)
    K = K + lent * B @ B.T
    root = 1.0 / np.sqrt(np.diag(M))
    squares, shapes = eigh(root[:, None] * K * root)
    if squares[0] > _HELD * squares[-1]:
        return
    shape = (root * shapes[:, 0])[: 6 * len(names)].reshape(-1, 6)
    size = np.abs(shape) * np.array([1.0, 1.0, 1.0, 0.3, 0.3, 0.3])
    body, way = np.unravel_index(int(np.argmax(size)), size.shape)
    how = f"along {'XYZ'[way]}" if way < 3 else f"about {'XYZ'[way - 3]}"
    raise ValueError(
        f"body {names[body]}: found no support {how}, expected springs or a drive; add carriages "
        "or a foundation, or give the present springs a stiffness in that direction"
    )
