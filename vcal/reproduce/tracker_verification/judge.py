"""What a test is judged by, as quantities that the GUM and a Monte Carlo have in common."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from ...machine.chain import Chain
from ...machine.plan import Plan
from ...model.forward import tool_columns
from ...model.port_map import PortMap
from ...numerics.arrays import Array
from ...numerics.spatial import rigid_basis
from ...uncertainty.outputs import Field, Output
from ...uncertainty.quantities import Measure, Pair, State

_MICRO = 1e-6
LEFT = "error left [um]"


class PointErrors(Measure):
    """Error that is left at every point, d = true less predicted tool point, in um.

    Scalars: components and length of d at some of the points. Field: components of d at all.
    They are not aligned, since the tracker's position counts as known.
    """

    true: PortMap
    found: PortMap
    nominal: Float[np.ndarray, "n 3"]
    position: Float[np.ndarray, "n 3"]
    chain: Chain
    rigid: Float[np.ndarray, "n3 6"]
    """Orthonormal columns of the rigid motions of all points."""
    named: tuple[int, ...] = eqx.field(static=True)
    places: tuple[str, ...] = eqx.field(static=True)

    @property
    def outputs(self) -> tuple[Output | Field, ...]:
        components = tuple(f"d{c} at {place} mm [um]" for place in self.places for c in "XYZ")
        lengths = tuple(f"|d| at {place} mm [um]" for place in self.places)
        return (
            Output("component", (len(components),), components),
            Output("length", (len(lengths),), lengths),
            Field(LEFT, self.nominal.shape),
        )

    def errors(self, state: State) -> tuple[Float[Array, "n 3"], Float[Array, "n 3"]]:
        """True less nominal tool points, and true less predicted ones, m."""
        true = self.true(state.true, state.true_shapes)
        found = self.found(state.found, state.found_shapes)
        real = jnp.stack(tool_columns(self.chain, self.position, true), -1)
        told = jnp.stack(tool_columns(self.chain, self.position, found), -1)
        return real - self.nominal, real - told

    def aligned(self, d: Float[Array, "n 3"]) -> Float[Array, "n 3"]:
        """Errors less the rigid motion that fits them best."""
        flat = d.reshape(-1)
        return (flat - self.rigid @ (self.rigid.T @ flat)).reshape(d.shape)

    def __call__(self, state: State) -> dict[str, Array]:
        _, left = self.errors(state)
        left = left / _MICRO
        some = left[jnp.asarray(self.named)]
        return {
            "component": some.reshape(-1),
            "length": jnp.sqrt((some * some).sum(-1)),
            LEFT: left,
        }


def point_errors(pair: Pair, points: Plan, every: int = 2) -> PointErrors:
    """The quantity at these points, a square grid of which `every` other row and column is named.

    Raises `ValueError` where the points are no square grid.
    """
    position = np.asarray(points.position)
    side = int(round(len(position) ** 0.5))
    if side * side != len(position):
        raise ValueError(f"found {len(position)} points, expected a square grid")
    named = [i * side + j for i in range(0, side, every) for j in range(0, side, every)]
    chain = pair.truth.chain
    still = [0.0] * len(pair.truth.layout)
    nominal = np.column_stack(tool_columns(chain, position, still))
    return PointErrors(
        *pair.maps(points),
        nominal=nominal,
        position=position,
        chain=chain,
        rigid=rigid_basis(nominal),
        named=tuple(named),
        places=tuple("({:g}, {:g})".format(*(1e3 * position[i, :2])) for i in named),
    )


def length_labels(measure: PointErrors) -> tuple[str, ...]:
    """Names of the lengths |d|."""
    return measure.outputs[1].labels  # type: ignore[union-attr]


def component_labels(measure: PointErrors) -> tuple[str, ...]:
    """Names of the components of d, three per point."""
    return measure.outputs[0].labels  # type: ignore[union-attr]
