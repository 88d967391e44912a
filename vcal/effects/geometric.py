"""The geometric errors of ISO 230-1: six error motions per joint and the location errors."""

from collections.abc import Collection, Iterable, Mapping, Sequence

import equinox as eqx
import numpy as np
from jaxtyping import Float

from ..distributions import Univariate
from ..machine.chain import Chain
from ..machine.error_functions import Basis, Constant, Legendre, Matern, Together, summed
from ..machine.parameters import Parameter
from ..machine.plan import Plan
from ..numerics.arrays import Array, namespace
from ..numerics.record import Record
from .base import Effect, Response, Setup, unit_of
from .registry import register

TRANSLATIONS = "XYZ"


class ErrorMotion(Record):
    """One error motion of one joint: its port, the axis it depends on, and its family of
    functions.
    """

    name: str = eqx.field(static=True)
    """ISO 230-1 name, such as ``"EXY"``."""
    axis: str = eqx.field(static=True)
    basis: Basis
    tied: str = eqx.field(static=True, default="")
    """Name of the error motion whose parameters it shares; empty for parameters of its own."""

    @property
    def unit(self) -> str:
        """``"um"`` for translations, ``"urad"`` for rotations."""
        return unit_of(self.name)


class LocationError(Record):
    """Error of the position or of the direction of an axis, ISO 230-1:2012, 3.6.

    For a linear axis: its squareness, such as EC0Y, a tilt of its direction. It moves along axis +
    tilt x axis: with EC0Y, y moves by (-EC0Y y, y, 0). For a rotary axis: two errors of its
    position (EX0C, EY0C) and two of its direction (EA0C, EB0C), which are constants.
    """

    name: str = eqx.field(static=True)
    axis: str = eqx.field(static=True)
    sigma: float
    """Prior standard deviation, m or rad."""
    column: tuple[tuple[str, float], ...] = eqx.field(static=True)
    """Error translation per radian and metre of travel, or the constant: ((port, factor), ...)."""
    constant: bool = eqx.field(static=True, default=False)
    """Whether it belongs to a rotary axis, and does not grow with the position."""
    law: Univariate | None = None
    """Distribution whose standardised form is that of the error; normal where there is none."""

    @property
    def unit(self) -> str:
        """``"um"`` for positions, ``"urad"`` for directions."""
        return unit_of(self.name)

    @classmethod
    def of(
        cls, chain: Chain, name: str, sigma: float, law: Univariate | None = None
    ) -> "LocationError":
        """From an ISO name such as ``"EC0Y"``."""
        axis = name[3:]
        joint = chain.joint(axis)
        if joint.turns:
            return cls(name, axis, sigma, ((f"E{name[1]}{axis}", 1.0),), constant=True, law=law)
        about = np.eye(3)["ABC".index(name[1])]
        tilt = joint.sign * np.cross(about, joint.direction)
        column = tuple(
            (f"E{c}{axis}", float(v)) for c, v in zip("XYZ", tilt, strict=True) if v != 0.0
        )
        return cls(name, axis, sigma, column, law=law)


class GeometricErrors(Effect):
    """Error motions as functions of the position of their own axis, and location errors.

    E(x) = sum_k theta_k f_k(x) with f_k and the prior of theta_k from the declared family of
    functions (`vcal.machine.error_functions`). ISO 230-1:2012, 3.4; error = actual - nominal, in
    the joint's own frame.
    """

    name = "geometric"
    summary = "error motions and location errors of the declared family"
    remedy = (
        "Compensate by the error motions and location errors of this report; realign where a "
        "squareness is large."
    )
    motions: tuple[ErrorMotion, ...] = ()
    locations: tuple[LocationError, ...] = ()

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        return tuple(
            Parameter(f"{m.name}.{label}", m.unit, sigma=float(sigma) / 1e-6, law=m.basis.law)
            for m in self.motions
            if not m.tied
            for label, sigma in zip(m.basis.labels, m.basis.sigma, strict=True)
        ) + tuple(
            Parameter(e.name, e.unit, sigma=float(e.sigma) / 1e-6, law=e.law)
            for e in self.locations
        )

    def response(self, plan: Plan, shape: Mapping[str, Array]) -> Response:
        columns = {}
        for m in self.motions:
            functions = m.basis.functions(plan.x(m.axis))
            for label, values in zip(m.basis.labels, _columns(functions), strict=True):
                columns[m.name, f"{m.tied or m.name}.{label}"] = values
        for e in self.locations:
            for port, factor in e.column:
                x = plan.x(e.axis)
                columns[port, e.name] = factor * (namespace(x).ones_like(x) if e.constant else x)
        return columns

    def errors(
        self, plan: Plan, amplitudes: Mapping[str, float], names: Collection[str]
    ) -> dict[str, Float[np.ndarray, " n"]]:
        """Errors (n,) at the ports, m or rad: `response` times `amplitudes` (SI, by the names of
        the parameters) of the error motions and location errors in `names`, summed. Faster where
        the rows are many.
        """
        found: dict[str, np.ndarray] = {}
        motions = [m for m in self.motions if m.name in names]
        for axis in dict.fromkeys(m.axis for m in motions):
            mine = [m for m in motions if m.axis == axis]
            sizes = [
                np.array([amplitudes[f"{m.tied or m.name}.{k}"] for k in m.basis.labels])
                for m in mine
            ]
            values = summed([m.basis for m in mine], sizes, np.asarray(plan.x(axis)))
            for m, column in zip(mine, values.T, strict=True):
                found[m.name] = found.get(m.name, 0.0) + column
        for e in (e for e in self.locations if e.name in names):
            x = np.asarray(plan.x(e.axis))
            for port, factor in e.column:
                column = factor * amplitudes[e.name] * (np.ones_like(x) if e.constant else x)
                found[port] = found.get(port, 0.0) + column
        return found


def link_errors(
    chain: Chain,
    translation_m: float,
    rotation_rad: float,
    slide_translation_m: float = 0.0,
    slide_rotation_rad: float = 0.0,
    smoothness: float = 0.5,
) -> GeometricErrors:
    """Six constant errors per joint of an arm, with their prior standard deviations.

    A prismatic joint also has six error motions along its travel (ISO 230-1: positioning,
    straightness, roll, pitch and yaw), smooth functions of the sizes `slide_translation_m` and
    `slide_rotation_rad` with the correlation length `smoothness` times the travel; none of size
    zero.
    """
    motions = []
    for joint in chain.joints:
        slides = not joint.turns and bool(np.isfinite(joint.travel).all())
        # The eigenfunctions are the expensive part, and all six motions of a joint share them.
        unit = Matern(joint.travel.tolist(), 1.0, smoothness) if slides else None
        for c in "XYZABC":
            moves = c in TRANSLATIONS
            basis: Basis = Constant(translation_m if moves else rotation_rad)
            size = slide_translation_m if moves else slide_rotation_rad
            if unit is not None and size > 0.0:
                smooth = eqx.tree_at(lambda b: b.sigma, unit, unit.sigma * size)
                basis = Together((basis, smooth))
            motions.append(ErrorMotion(f"E{c}{joint.name}", joint.name, basis))
    return GeometricErrors(motions=tuple(motions))


@register
class GeometricOrder(Effect):
    """Two more Legendre degrees of one error motion than its declared family can represent.

    E(x) += a P_n(u) + b P_(n+1)(u), with n one above the highest degree that the family can
    represent. Higher degrees, and narrower deviations, are reported as *unexplained* rather than as
    geometry.
    """

    name = "geometric_order"
    summary = "two more Legendre degrees of one error motion"
    remedy = (
        "Compensate by a table with more points along this axis; check the guideway for local wear."
    )
    motion: str = eqx.field(static=True)
    axis: str = eqx.field(static=True)
    basis: Basis

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        unit = unit_of(self.motion)
        return tuple(Parameter(label, unit, sigma=10.0) for label in self.basis.labels)

    @property
    def needs(self) -> tuple[str, ...]:
        return (self.axis,)

    def response(self, plan: Plan, shape: Mapping[str, Array]) -> Response:
        functions = _columns(self.basis.functions(plan.x(self.axis)))
        return {
            (self.motion, label): values
            for label, values in zip(self.basis.labels, functions, strict=True)
        }

    @classmethod
    def candidates(cls, setup: Setup) -> Iterable[Effect]:
        for effect in setup.declared:
            if not isinstance(effect, GeometricErrors):
                continue
            for m in effect.motions:
                if setup.chain.joint(m.axis).around:
                    continue  # a periodic error motion is no polynomial: it has its harmonics
                low, high = setup.chain.joint(m.axis).travel
                if not (np.isfinite(low) and np.isfinite(high)):
                    x = np.asarray(setup.plan.x(m.axis))
                    low, high = x.min(), x.max()
                degree = _resolved_degree(m.basis, low, high)
                yield cls(
                    motion=m.name,
                    axis=m.axis,
                    basis=Legendre((low, high), (degree + 1, degree + 2), 1.0),
                    placement=m.name,
                )


def _resolved_degree(basis: Basis, low: float, high: float) -> int:
    """Highest Legendre degree n such that the family represents each degree up to n to 10 %."""
    x = np.linspace(low, high, 201)
    family = np.asarray(basis.functions(x)) if basis.labels else np.zeros((201, 0))
    family = np.column_stack([family, np.ones(201), x])
    q, _ = np.linalg.qr(family)
    for degree in range(2, 12):
        p = np.asarray(Legendre((low, high), (degree,), 1.0).functions(x))[:, 0]
        if np.linalg.norm(p - q @ (q.T @ p)) > 0.1 * np.linalg.norm(p):
            return degree - 1
    return 11


def _columns(values: Float[Array, "n k"]) -> Sequence[Float[Array, " n"]]:
    """The columns one by one."""
    return namespace(values).unstack(values, axis=1)
