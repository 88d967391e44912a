"""Rotations and rigid motions, exact and differentiable at the identity."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from .arrays import Array


def skew(v: Float[Array, "3"]) -> Float[Array, "3 3"]:
    """Cross-product matrix: ``skew(v) @ u == cross(v, u)``."""
    x, y, z = v
    zero = jnp.zeros_like(x)
    return jnp.stack([jnp.stack([zero, -z, y]), jnp.stack([z, zero, -x]), jnp.stack([-y, x, zero])])


def rotation(v: Float[Array, "3"]) -> Float[Array, "3 3"]:
    """Rotation matrix of the rotation vector `v` (rad): R = exp(skew(v)), by Rodrigues' formula.

    Below an angle of 1e-4 rad the coefficients are taken from their series. Its truncation error is
    below the rounding of float64, and value and all derivatives are finite at v = 0.
    """
    squared = v @ v
    small = squared < 1e-8
    safe = jnp.where(small, 1.0, squared)
    angle = jnp.sqrt(safe)
    a = jnp.where(small, 1.0 - squared / 6.0, jnp.sin(angle) / angle)
    b = jnp.where(small, 0.5 - squared / 24.0, (1.0 - jnp.cos(angle)) / safe)
    s = skew(v)
    return jnp.eye(3) + a * s + b * (s @ s)


def axis_rotation(axis: str, angle: Float[Array, ""]) -> Float[Array, "3 3"]:
    """Rotation by `angle` (rad) about the coordinate axis ``"x"``, ``"y"`` or ``"z"``."""
    c, s = jnp.cos(angle), jnp.sin(angle)
    one, zero = jnp.ones_like(c), jnp.zeros_like(c)
    rows = {
        "x": [[one, zero, zero], [zero, c, -s], [zero, s, c]],
        "y": [[c, zero, s], [zero, one, zero], [-s, zero, c]],
        "z": [[c, -s, zero], [s, c, zero], [zero, zero, one]],
    }[axis]
    return jnp.stack([jnp.stack(row) for row in rows])


def euler_xyz(angles: Float[Array, "3"]) -> Float[Array, "3 3"]:
    """R = Rx(a) Ry(b) Rz(c) for `angles` = (a, b, c) in rad."""
    a, b, c = angles
    return axis_rotation("x", a) @ axis_rotation("y", b) @ axis_rotation("z", c)


def best_rigid(source: np.ndarray, target: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Rotation R (3, 3) and translation t (3,) that minimise the sum of |R source + t - target|^2.

    Kabsch's solution by singular value decomposition. `source` and `target` are (n, 3), n >= 3
    points that do not lie on one line.
    """
    cs, ct = source.mean(0), target.mean(0)
    u, _, vt = np.linalg.svd((source - cs).T @ (target - ct))
    sign = np.sign(np.linalg.det(vt.T @ u.T))
    r = vt.T @ np.diag([1.0, 1.0, sign]) @ u.T
    return r, ct - r @ cs


def rigid_columns(points: np.ndarray) -> np.ndarray:
    """Displacement (n, 3, 6) of `points` (n, 3) per unit of a rigid motion, translations first."""
    columns = np.zeros((len(points), 3, 6))
    columns[:, :, :3] = np.eye(3)
    x, y, z = points.T
    columns[:, 1, 3], columns[:, 2, 3] = -z, y
    columns[:, 0, 4], columns[:, 2, 4] = z, -x
    columns[:, 0, 5], columns[:, 1, 5] = -y, x
    return columns


def rigid_basis(points: np.ndarray) -> np.ndarray:
    """Orthonormal displacements (3 n, r) that span the rigid motions of `points` (n, 3).

    r = 6 in general; 5 for points on one line, as a rotation about the line does not move them; 3
    for points that coincide.
    """
    arms = points - points.mean(0)
    columns = rigid_columns(arms)
    # All rotations have one scale: a rotation that moves nothing must not be scaled up.
    columns[:, :, 3:] /= np.sqrt((arms**2).sum(1).mean()) or 1.0
    u, s, _ = np.linalg.svd(columns.reshape(-1, 6), full_matrices=False)
    return u[:, s > 1e-9 * s[0]]


def after_alignment(found: np.ndarray, target: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The differences target - (R found + t) (n, 3) after the best rigid alignment (`best_rigid`,
    exact for any rotation), and R (3, 3).

    `found` and `target` (n, 3) in m may be given in any two frames. Volumetric errors are compared
    after this alignment, because a measurement from a station or artefact of unknown pose contains
    no information about a rigid motion. The derivative of the sum of their squares by `found` is
    -2 R'(target - R found - t), as R and t minimise it.
    """
    r, t = best_rigid(found, target)
    return target - (found @ r.T + t), r


def after_small_alignment(
    found: Float[Array, "n 3"], target: Float[Array, "n 3"]
) -> Float[Array, "n 3"]:
    """`after_alignment` for points in the same frame up to rotations of 0.1 rad, traced and
    differentiable.

    Three Newton steps from the identity w = (tr(A) 1 - (A + A')/2)^-1 sum a x b, A = sum b a', for
    the points a and b about their centroids, reach the closed form to rounding. The derivative of a
    singular value decomposition does not exist where singular values coincide.
    """
    target = target - target.mean(0)
    turned = found - found.mean(0)
    for _ in range(3):
        a = target.T @ turned
        size = jnp.trace(a)
        # Points on a line: the rotation about it has no gradient, and must have a curvature.
        curvature = (size + 1e-12 * jnp.abs(size) + 1e-300) * jnp.eye(3) - 0.5 * (a + a.T)
        turn = rotation(jnp.linalg.solve(curvature, jnp.cross(turned, target).sum(0)))
        turned = turned @ turn.T
    return target - turned


def align_rigid(points: np.ndarray, displacements: np.ndarray) -> np.ndarray:
    """Displacements minus the rigid motion that fits them best, to first order (least squares).

    `points` (n, 3) and `displacements` (n, 3, ...) in m. It is meant for derivatives, which are of
    first order themselves; `after_alignment` compares points.
    """
    rigid = rigid_basis(points)
    flat = displacements.reshape(len(rigid), -1)
    return (flat - rigid @ (rigid.T @ flat)).reshape(displacements.shape)


def require_float64() -> None:
    """Raise `RuntimeError` if JAX runs in float32: 1 nm in 3 m is 3e-10 and would be lost.

    The message explains how to switch to float64.
    """
    if not jax.config.jax_enable_x64:  # pyright: ignore[reportAttributeAccessIssue]
        raise RuntimeError(
            "vcal computes in float64, but JAX is set to float32. Call vcal.enable_float64() "
            "(or jax.config.update('jax_enable_x64', True)) once, before any other call."
        )
