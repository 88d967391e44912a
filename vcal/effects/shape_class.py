"""An effect whose shape is one of several that the readings cannot distinguish."""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import equinox as eqx
import numpy as np

from ..machine.plan import Plan
from ..numerics.arrays import Array
from .base import Effect, Response
from .wrapper import Wrapper

Shape = tuple[tuple[str, float], ...]
"""Name and value (SI) of every shape parameter."""
Member = tuple[float, Shape, tuple[tuple[float, ...], ...]]
"""Weight, shape, and the matrix from the amplitudes of the first member to those of this one."""


class ShapeClass(Wrapper):
    """The mean of an effect over shapes that give the same readings.

    On a lattice of positions of the step s, a wave of the pitch p cannot be distinguished from
    those of 1/p' = |1/p + k/s|. With the columns C_i of member i, and R_i so that C_i R_i equals
    the columns of the first member in all readings, the response is the sum of w_i C_i R_i. It
    equals that of every member in the readings. Elsewhere it is what they have in common, and its
    square error is smaller than that of no effect, whichever member is true, if the weights are
    equal and the members are uncorrelated there.

    The amplitudes are those of the first member, whose shape counts as known.
    """

    members: tuple[Member, ...] = eqx.field(static=True)

    @classmethod
    def of(
        cls,
        effect: Effect,
        shapes: Sequence[Mapping[str, float]],
        weights: Sequence[float],
        matrices: Sequence[np.ndarray],
    ) -> "ShapeClass":
        """The class of these shapes (SI), the first of which is the one that is stated; `matrices`
        (amplitudes, amplitudes) in SI.
        """
        members = tuple(
            (float(w), tuple(shape.items()), tuple(map(tuple, np.asarray(m).tolist())))
            for w, shape, m in zip(weights, shapes, matrices, strict=True)
        )
        known = with_shape(effect, shapes[0])
        options = {"placement": effect.placement, "given": known.given, "priors": effect.priors}
        return cls(known, members, **options)

    def response(self, plan: Plan, shape: Mapping[str, Array]) -> Response:
        del shape
        amplitudes = [p.name for p in self.effect.amplitudes]
        found: dict[tuple[str, str], Array] = {}
        for weight, its, matrix in self.members:
            values = {name: np.asarray(value) for name, value in its}
            for (port, name), column in self.effect.response(plan, values).items():
                row = matrix[amplitudes.index(name)]
                for other, factor in zip(amplitudes, row, strict=True):
                    found[port, other] = found.get((port, other), 0.0) + weight * factor * column
        return found


def with_shape(effect: Effect, shape: Mapping[str, float]) -> Effect:
    """The effect with known shape parameters (SI)."""
    known = tuple((p.name, shape[p.name] / p.si, 0.0) for p in effect.shapes)
    others = tuple(row for row in effect.given if row[0] not in shape)
    priors = tuple(prior for prior in effect.priors if not {*shape} & {*prior.names})
    return replace(effect, given=(*others, *known), priors=priors)
