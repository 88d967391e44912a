"""Orientations in files, as unit quaternions or Euler angles, and small rotations as readings."""

from collections.abc import Mapping
from typing import Literal, get_args

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from ..errors import RowError
from ..numerics.eigen import eigh
from .base import Column

Convention = Literal["quaternion", "euler_xyz", "euler_zyx", "euler_zyz"]
"""How an orientation R, from the frame of the probe to that of the instrument, is written.

- ``quaternion``: ``qw``, ``qx``, ``qy``, ``qz``, of unit length and either sign;
- ``euler_xyz``: R = Rx(rx) Ry(ry) Rz(rz), angles in deg;
- ``euler_zyx``: R = Rz(rz) Ry(ry) Rx(rx) (yaw, pitch, roll);
- ``euler_zyz``: R = Rz(rz1) Ry(ry) Rz(rz2).
"""
_COLUMNS: Mapping[str, tuple[str, ...]] = {
    "quaternion": ("qw", "qx", "qy", "qz"),
    "euler_xyz": ("rx_deg", "ry_deg", "rz_deg"),
    "euler_zyx": ("rz_deg", "ry_deg", "rx_deg"),
    "euler_zyz": ("rz1_deg", "ry_deg", "rz2_deg"),
}
CONVENTIONS: tuple[Convention, ...] = get_args(Convention)
_UNIT = 0.01
"""Largest deviation of the length of a quaternion from one."""


def orientation_names(convention: str) -> tuple[str, ...]:
    """The columns of a convention."""
    return _COLUMNS[convention]


def orientation_columns(convention: str) -> list[Column]:
    """Their declarations."""
    most = 1.0 + _UNIT if convention == "quaternion" else 720.0
    return [Column(name=name, low=-most, high=most) for name in _COLUMNS[convention]]


def orientations(table: Mapping[str, np.ndarray], convention: str) -> Float[np.ndarray, "n 3 3"]:
    """Orientations of all rows of a table. Raises `RowError` for a quaternion whose length differs
    from one by more than a hundredth.
    """
    names = _COLUMNS[convention]
    values = np.column_stack([np.asarray(table[name], float) for name in names])
    if convention != "quaternion":
        return Rotation.from_euler(_letters(convention), values, degrees=True).as_matrix()
    length = np.linalg.norm(values, axis=1)
    if (bad := np.abs(length - 1.0) > _UNIT).any():
        row = int(np.argmax(bad))
        raise RowError(
            row,
            f"columns {', '.join(names)}",
            f"a quaternion of length {length[row]:.4g}",
            "unit length, with the scalar part in qw",
            "correct the columns, or name the convention in instrument.orientation",
        )
    return Rotation.from_quat(values, scalar_first=True).as_matrix()


def orientation_table(turns: Float[np.ndarray, "n 3 3"], convention: str) -> dict[str, np.ndarray]:
    """The inverse of `orientations`; quaternions have a scalar part of at least zero."""
    found = Rotation.from_matrix(turns)
    if convention == "quaternion":
        values = found.as_quat(canonical=True, scalar_first=True)
    else:
        values = found.as_euler(_letters(convention), degrees=True)
    return dict(zip(_COLUMNS[convention], values.T, strict=True))


def _letters(convention: str) -> str:
    return convention.removeprefix("euler_").upper()


def turns(r: Float[np.ndarray, "n 3 3"]) -> Float[np.ndarray, "n 3"]:
    """Readings (n, 3) of rotations: sin(angle) times the axis, the vector of (R - R') / 2.

    They equal the rotation vectors to second order, and are smooth at the identity.
    """
    return 0.5 * np.stack(
        [r[:, 2, 1] - r[:, 1, 2], r[:, 0, 2] - r[:, 2, 0], r[:, 1, 0] - r[:, 0, 1]], axis=1
    )


def unturned(values: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3 3"]:
    """The rotations below 90 degrees with these readings."""
    sine = np.linalg.norm(values, axis=1, keepdims=True)
    factor = np.where(sine > 0.0, np.arcsin(np.minimum(sine, 1.0)) / np.maximum(sine, 1e-300), 1.0)
    return Rotation.from_rotvec(factor * values).as_matrix()


def angles(r: Float[np.ndarray, "n 3 3"]) -> Float[np.ndarray, " n"]:
    """Angles of rotations, deg."""
    return np.degrees(Rotation.from_matrix(r).magnitude())


def between_frames(
    nominal: Float[np.ndarray, "n 3 3"], seen: Float[np.ndarray, "n 3 3"]
) -> tuple[Float[np.ndarray, "3 3"], Float[np.ndarray, "3 3"]]:
    """Rotations S and T with S seen = nominal T, by least squares (robot-world calibration).

    Stacked in the elements of both, the equations are linear and homogeneous; their best solution
    is the singular vector of the smallest singular value, up to its sign. Both parts are then
    replaced by the nearest rotations, and improved in turn. Source: Shah, J. Mechanisms Robotics 5
    (2013) 031007.
    """
    eye = np.eye(3)
    normal = np.zeros((18, 18))
    for a, b in zip(seen, nominal, strict=True):
        rows = np.hstack([np.kron(eye, a.T), -np.kron(b, eye)])
        normal += rows.T @ rows
    vector = eigh(normal)[1][:, 0]
    first = vector[:9].reshape(3, 3)
    s = _nearest(first * (np.sign(np.linalg.det(first)) or 1.0))
    t = eye
    for _ in range(50):
        t = _nearest(np.einsum("nji,jk,nkl->il", nominal, s, seen))
        new = _nearest(np.einsum("nij,jk,nlk->il", nominal, t, seen))
        if np.abs(new - s).max() < 1e-12:
            break
        s = new
    return s, t


def _nearest(m: Float[np.ndarray, "3 3"]) -> Float[np.ndarray, "3 3"]:
    """The rotation nearest to a matrix."""
    u, _, vt = np.linalg.svd(m)
    u[:, 2] *= np.linalg.det(u @ vt)
    return u @ vt
