"""Volumetric error of the identified machine on a grid over the travel of X, Y and Z."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from ..identification.fit import Fit
from ..identification.model_averaging import Alternatives, model_average
from ..model.measurement import CheckPoints
from ..numerics.spatial import after_alignment, align_rigid
from .compensated import compensated_in_blocks

_NODES = 9
"""Grid points along an axis; odd, so that the mid-planes are among them."""
_NOTHING_UM = 1e-9


@dataclass(frozen=True)
class ErrorField:
    """Volumetric error on a grid over the travel, after rigid alignment."""

    nodes: Mapping[str, Float[np.ndarray, " n"]]
    """Grid along each of X, Y and Z, m."""
    error: Float[np.ndarray, "n n n 3"]
    """Identified error, actual - nominal, um; the axes of the array are X, Y and Z."""
    change: Float[np.ndarray, "n n n 3"]
    """Its change by closing the loop, um: what a compensation with the declared model leaves."""
    u: Float[np.ndarray, "n n n"]
    """Standard uncertainty of the length of the error vector, um."""

    def plane(self, values: np.ndarray, first: str, second: str) -> np.ndarray:
        """Values of the mid-plane of two axes; its first array axis is along `first`."""
        (third,) = (i for i, axis in enumerate("XYZ") if axis not in (first, second))
        return np.take(values, values.shape[third] // 2, axis=third)


def error_field(
    before: Fit,
    after: Fit,
    check: CheckPoints | None = None,
    alternatives: Sequence[Alternatives] = (),
) -> ErrorField | None:
    """The identified error field of a machine with the axes X, Y and Z; None for other machines,
    and for models without any dependence on the position.

    It contains only what depends on the axis positions alone: no direction, temperature or time.
    With check points, it is computed in blocks of their number, so that nothing has to be compiled
    again. The uncertainty includes the between-model variance of the `alternatives`.
    """
    chain = after.model.chain
    if set(chain.axes) != set("XYZ"):
        return None
    size = check.plan.rows if check is not None else 0
    plan = after.measurement.plan
    line = {}
    for axis in "XYZ":
        low, high = chain.joint(axis).travel
        if not np.isfinite([low, high]).all():
            low, high = np.asarray(plan.x(axis)).min(), np.asarray(plan.x(axis)).max()
        line[axis] = np.linspace(low, high, _NODES)
    grid = np.stack(np.meshgrid(*line.values(), indexing="ij"), -1).reshape(-1, 3)
    position = grid[:, ["XYZ".index(axis) for axis in chain.axes]]
    nominal = grid + np.asarray(chain.tool_offset)

    def points(fit: Fit) -> tuple[np.ndarray, np.ndarray]:
        return compensated_in_blocks(fit, position, size or len(position))

    def identified(fit: Fit) -> np.ndarray:
        return -after_alignment(points(fit)[0], nominal)[0]

    found, jacobian = points(after)
    left, turn = after_alignment(found, nominal)
    moved, between = model_average(alternatives, identified, np.zeros_like(nominal))
    errors = [1e6 * identified(before), 1e6 * (moved - left)]
    free = align_rigid(nominal, turn @ jacobian)
    variance = ((free @ after.covariance) * free).sum((1, 2))
    variance += between.sum(1)
    if variance.max() == 0.0 and max(np.abs(e).max() for e in errors) < _NOTHING_UM:
        return None
    shape = (_NODES,) * 3
    return ErrorField(
        nodes=line,
        error=errors[1].reshape(*shape, 3),
        change=(errors[1] - errors[0]).reshape(*shape, 3),
        u=np.sqrt(variance).reshape(shape) * 1e6,
    )
