"""Vectors and rotations as separate components, for functions that are mapped over rows and draws.

With an array of shape (3, 3) per row and draw, every product is a tiny matrix product that is
written to memory. With nine scalars, the whole path of an observation is one elementwise
expression, which the compiler evaluates in registers: fifteen times as fast. Components that are
plain Python numbers are constants: products with 0 and 1 are left out.
"""

import math
from typing import Any, overload

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.core import Tracer

from .arrays import Array
from .record import Record
from .spatial import skew

Scalar = float | Array
"""One component: a Python number (a constant), or an array without axes."""

_TERMS = 12
_FLOAT = np.dtype(np.float64)


def _plus(a: Scalar, b: Scalar) -> Scalar:
    if isinstance(a, float) and a == 0.0:
        return b
    if isinstance(b, float) and b == 0.0:
        return a
    pair = _alike(a, b)
    return a + b if pair is None else lax.add(*pair)


def _minus(a: Scalar, b: Scalar) -> Scalar:
    if isinstance(b, float) and b == 0.0:
        return a
    if isinstance(a, float) and a == 0.0:
        return -b
    pair = _alike(a, b)
    return a - b if pair is None else lax.sub(*pair)


def _times(a: Scalar, b: Scalar) -> Scalar:
    for one, other in ((a, b), (b, a)):
        if isinstance(one, float):
            if one == 0.0:
                return 0.0
            if one == 1.0:
                return other
            if one == -1.0:
                return -other
    pair = _alike(a, b)
    return a * b if pair is None else lax.mul(*pair)


def _alike(a: Scalar, b: Scalar) -> tuple[Any, Any] | None:
    """Both as operands of one operation of `jax.lax`, where one of them is traced and nothing has
    to be promoted; None elsewhere.

    An operator of `jax.numpy` is a compiled function of its own, which is traced and inlined: that
    takes four times as long, for the same operation.
    """
    known, traced = (a, b) if isinstance(b, Tracer) else (b, a)
    if not isinstance(traced, Tracer) or traced.dtype != _FLOAT or traced.weak_type:
        return None
    if type(known) is float:
        if traced.shape:
            return None
        known = _FLOAT.type(known)
    elif not isinstance(known, Tracer):
        return None
    elif known.dtype != _FLOAT or known.weak_type or known.shape != traced.shape:
        return None
    return (known, traced) if isinstance(b, Tracer) else (traced, known)


class Vector(Record):
    """A vector by its three components."""

    x: Scalar
    y: Scalar
    z: Scalar

    @classmethod
    def of(cls, values) -> "Vector":
        """From a sequence or array (3,); the components of a numpy array are constants."""
        if isinstance(values, np.ndarray):
            values = values.tolist()
        return cls(values[0], values[1], values[2])

    @property
    def parts(self) -> tuple[Scalar, Scalar, Scalar]:
        """(x, y, z)."""
        return self.x, self.y, self.z

    def __add__(self, other: "Vector") -> "Vector":
        return Vector(_plus(self.x, other.x), _plus(self.y, other.y), _plus(self.z, other.z))

    def __sub__(self, other: "Vector") -> "Vector":
        return Vector(_minus(self.x, other.x), _minus(self.y, other.y), _minus(self.z, other.z))

    def __neg__(self) -> "Vector":
        return self * -1.0

    def __mul__(self, factor: Scalar) -> "Vector":
        return Vector(_times(self.x, factor), _times(self.y, factor), _times(self.z, factor))

    def dot(self, other: "Vector") -> Scalar:
        """Scalar product."""
        return _plus(
            _plus(_times(self.x, other.x), _times(self.y, other.y)), _times(self.z, other.z)
        )

    def cross(self, other: "Vector") -> "Vector":
        """Vector product self x other."""
        return Vector(
            _minus(_times(self.y, other.z), _times(self.z, other.y)),
            _minus(_times(self.z, other.x), _times(self.x, other.z)),
            _minus(_times(self.x, other.y), _times(self.y, other.x)),
        )

    def array(self) -> Array:
        """As an array of shape (3,)."""
        return jnp.stack([jnp.asarray(c) for c in self.parts])


class Rotation(Record):
    """A rotation matrix by its rows."""

    rows: tuple[Vector, ...]

    @classmethod
    def of(cls, matrix) -> "Rotation":
        """From an array (3, 3); the components of a numpy array are constants."""
        return cls((Vector.of(matrix[0]), Vector.of(matrix[1]), Vector.of(matrix[2])))

    @property
    def T(self) -> "Rotation":
        """The inverse."""
        x, y, z = (row.parts for row in self.rows)
        return Rotation(
            (Vector(x[0], y[0], z[0]), Vector(x[1], y[1], z[1]), Vector(x[2], y[2], z[2]))
        )

    @overload
    def __matmul__(self, other: Vector) -> Vector: ...
    @overload
    def __matmul__(self, other: "Rotation") -> "Rotation": ...
    def __matmul__(self, other):
        if isinstance(other, Vector):
            return Vector(*(row.dot(other) for row in self.rows))
        columns = other.T.rows
        return Rotation(tuple(Vector(*(row.dot(c) for c in columns)) for row in self.rows))

    def array(self) -> Array:
        """As an array of shape (3, 3)."""
        return jnp.stack([row.array() for row in self.rows])


IDENTITY = Rotation.of(np.eye(3))
ORIGIN = Vector(0.0, 0.0, 0.0)


def placement(matrix: Array) -> tuple[Rotation, Vector]:
    """Rotation and translation of a homogeneous matrix (4, 4)."""
    return Rotation.of(matrix[:3, :3]), Vector.of(matrix[:3, 3])


def about(axis: Vector, angle: Scalar) -> Rotation:
    """Rotation by `angle` (rad) about the unit vector `axis`, Rodrigues' formula."""
    s, c = jnp.sin(angle), jnp.cos(angle)
    x, y, z = axis.parts
    k = Rotation((Vector(0.0, -z, y), Vector(z, 0.0, -x), Vector(-y, x, 0.0)))
    return _combined(k, s, k @ k, 1.0 - c)


def _combined(k: Rotation, a: Scalar, kk: Rotation, b: Scalar) -> Rotation:
    """I + a K + b K^2."""
    rows = (i + k * a + kk * b for i, k, kk in zip(IDENTITY.rows, k.rows, kk.rows, strict=True))
    return Rotation(tuple(rows))


def _series(first: int, squared: Scalar) -> Scalar:
    """sum_i (-1)^i s^i / (2 i + first)!, by Horner's rule."""
    terms = [(-1) ** i / math.factorial(2 * i + first) for i in range(_TERMS)]
    total: Scalar = terms[-1]
    for term in terms[-2::-1]:
        total = _plus(_times(total, squared), term)
    return total


def exp(v: Vector) -> Rotation:
    """Rotation by the rotation vector `v` (rad), intended for small errors: R = exp(skew(v)).

    R = I + sin(t)/t K + (1 - cos t)/t^2 K^2 with K = skew(v), t = |v|. Both coefficients are power
    series in t^2, which have no branch at zero and need no library call. They are exact to rounding
    up to 1 rad, and to 1e-13 up to pi. The derivative is dR = skew(J dv) R with
    J = I + (1 - cos t)/t^2 K + (t - sin t)/t^3 K^2.
    """
    if all(isinstance(c, float) and c == 0.0 for c in v.parts):
        return IDENTITY
    return _exp(v)


@eqx.filter_custom_jvp
def _exp(v: Vector) -> Rotation:
    x, y, z = v.parts
    squared = v.dot(v)
    a, b = _series(1, squared), _series(2, squared)
    k = Rotation((Vector(0.0, -z, y), Vector(z, 0.0, -x), Vector(-y, x, 0.0)))
    return _combined(k, a, k @ k, b)


@_exp.def_jvp
def _(primals, tangents):
    (v,), (slope,) = primals, tangents
    dv = Vector(*(0.0 if c is None else c for c in (slope.x, slope.y, slope.z)))
    r = _exp(v)
    return r, jax.tree.map(like, spun(r, left_jacobian(v, dv)), r)


def like(value: Scalar, other: Scalar) -> Array:
    """`value` as an array of the shape and type of `other`."""
    return jnp.broadcast_to(jnp.asarray(value, jnp.result_type(other)), jnp.shape(other))


def left_jacobian(v: Vector, dv: Vector) -> Vector:
    """Rotation in the fixed frame by a change `dv` of the rotation vector `v`: J dv (rad)."""
    squared = v.dot(v)
    first = v.cross(dv)
    return dv + first * _series(2, squared) + v.cross(first) * _series(3, squared)


def left_jacobian_matrix(v: Array) -> Array:
    """The matrix (3, 3) of `left_jacobian`: I + (1 - cos t)/t^2 K + (t - sin t)/t^3 K^2."""
    k, squared = skew(v), v @ v
    return jnp.eye(3) + _series(2, squared) * k + _series(3, squared) * (k @ k)


def spun(r: Rotation, w: Vector) -> Rotation:
    """skew(w) R: the change of a rotation matrix under the small rotation `w`."""
    columns = r.T.rows
    return Rotation(tuple(w.cross(c) for c in columns)).T
