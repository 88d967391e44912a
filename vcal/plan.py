"""What was commanded, and under which conditions: one row per observation."""

from collections.abc import Mapping

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Float, Int

from .arrays import Array


class Plan(eqx.Module):
    """Positions and conditions of all observations of a run, in the order of time.

    A pytree of arrays with a leading row axis (n). A covariate that was not recorded is absent; an
    effect that needs it then cannot be tested, and says so.
    """

    axes: tuple[str, ...] = eqx.field(static=True)
    """Names of the joints, in the order of the columns of `position`."""
    position: Float[Array, "n axes"]
    """Axis positions, m or rad. Commanded, or found (ball array), or read back (arm)."""
    covariates: Mapping[str, Float[Array, " n"]] = eqx.field(default_factory=dict)
    """Everything else that was recorded, SI, by name: ``"dir_X"`` (+1, -1), ``"t"`` (s),
    ``"T_X"``, ``"T_air"`` (degC), ``"commanded_J1"``, ``"read_J1"`` (rad), ..."""
    groups: Mapping[str, Int[Array, " n"]] = eqx.field(default_factory=dict)
    """Group indices by name: ``"pose"``, ``"ball"``, ``"run"``, ``"segment"``."""

    @property
    def rows(self) -> int:
        """Number of observations."""
        return self.position.shape[0]

    def x(self, axis: str) -> Float[Array, " n"]:
        """Position of one axis."""
        return self.position[:, self.axes.index(axis)]

    def covariate(self, name: str) -> Float[Array, " n"]:
        """A recorded covariate by name; `KeyError` where it was not recorded."""
        return self.covariates[name]

    def has(self, *names: str) -> bool:
        """Whether all of these covariates, groups or axes were recorded."""
        known = {*self.covariates, *self.groups, *self.axes}
        return all(name in known for name in names)

    def with_position(self, position: Float[Array, "n axes"]) -> "Plan":
        """The same plan at other axis positions."""
        return Plan(self.axes, position, self.covariates, self.groups)

    def take(self, rows) -> "Plan":
        """The given rows only."""
        pick = lambda table: {k: jnp.asarray(v)[rows] for k, v in table.items()}  # noqa: E731
        return Plan(self.axes, self.position[rows], pick(self.covariates), pick(self.groups))
