"""Correlated errors of an artefact's balls, with the covariance of a calibration of its shape."""

from collections.abc import Mapping

import equinox as eqx
import numpy as np
from jaxtyping import Float

from ..effects.base import Effect, Response
from ..machine.parameters import Parameter
from ..machine.plan import Plan
from ..numerics.arrays import Array
from ..numerics.eigen import eigh
from ..numerics.spatial import rigid_columns


class BallShape(Effect):
    """Ball errors e = sum_i a_i t_i with independent a_i ~ (0, 1): t_i are the columns of T, with
    the covariance T T' = K^-1 after a calibration with the precision K. Rigid motions of the whole
    artefact are excluded, since a calibration of its shape does not determine them.

    With `poses`, the errors are independent in each of them (heat, handling); without, they are the
    same in all.
    """

    name = "ball_shape"
    summary = "ball positions as uncertain as the artefact's shape"
    where = "instrument"
    columns: Float[np.ndarray, "N 3 c"]
    """T, m per standard deviation."""
    poses: tuple[int, ...] = eqx.field(static=True, default=())

    @classmethod
    def of(
        cls,
        balls: Float[np.ndarray, "N 3"],
        precision: Float[np.ndarray, "n n"],
        loosest_m: float,
        poses: tuple[int, ...] = (),
    ) -> "BallShape":
        """From ball centres (m) and the precision K of their errors (1/m^2). Standard deviations
        are at most `loosest_m`.
        """
        rigid = rigid_columns(balls - balls.mean(0)).reshape(-1, 6)
        u, sizes, _ = np.linalg.svd(rigid, full_matrices=True)
        shapes = u[:, int((sizes > 1e-9 * sizes[0]).sum()) :]
        values, vectors = eigh(shapes.T @ np.asarray(precision) @ shapes)
        sigma = 1.0 / np.sqrt(np.maximum(values, loosest_m**-2))
        columns = shapes @ vectors * sigma
        return cls(columns=columns.reshape(len(balls), 3, -1), poses=poses)

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        count = self.columns.shape[2]
        places = [f"{pose}." for pose in self.poses] or [""]
        return tuple(
            Parameter(f"{place}{i}", "1", sigma=1.0) for place in places for i in range(count)
        )

    def response(self, plan: Plan, shape: Mapping[str, Array]) -> Response:
        ball, found = np.asarray(plan.groups["ball"]), {}
        own = [(f"{p}.", np.asarray(plan.groups["pose"]) == p) for p in self.poses]
        for place, rows in own or [("", np.ones(plan.rows, bool))]:
            for j, c in enumerate("XYZ"):
                for i, column in enumerate(self.columns[ball, j].T):
                    found[f"ball.{c}", f"{place}{i}"] = np.where(rows, column, 0.0)
        return found
