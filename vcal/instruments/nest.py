"""Three probes in a nest that measure the position of a precision sphere (Weikert, Knapp (2004),
CIRP Annals 53(1), 429-432): the common part of such instruments.
"""

from collections.abc import Mapping, Sequence
from typing import Annotated, ClassVar, Self

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float
from pydantic import model_validator

from ..bounds import Noise, Radius, Range, Uncertainty, Within
from ..effects.base import Effect, Response
from ..machine.parameters import Parameter
from ..machine.plan import Plan
from ..numerics.arrays import Array
from ..numerics.record import Record
from ..numerics.rigid import Scalar, Vector
from .base import Column, InstrumentSettings

COORDINATES = ("x_ext_mm", "y_ext_mm", "z_ext_mm")
PROBES = ("p1_mm", "p2_mm", "p3_mm")
_Direction = Annotated[float, Within(-1e3, 1e3, "a direction has components of the size of one")]
Triple = tuple[_Direction, _Direction, _Direction]


class NestSettings(InstrumentSettings):
    """Keys of ``[instrument]`` that describe the probes."""

    external_sigma_um: Noise
    """Noise of a measured coordinate."""
    external_u_um: Uncertainty = 0.0
    """Standard uncertainty of a coordinate at the end of the range, from the calibration of the
    sensitivities and directions of the probes. It does not average out over a run.
    """
    range_mm: Range = 3.0
    """Range of the probes in every direction."""
    probes: tuple[Triple, Triple, Triple] | None = None
    """Directions from the sphere to the three probes, where the data contain the readings p1_mm,
    p2_mm, p3_mm of the probes instead of coordinates.
    """
    sphere_radius_mm: Radius = 11.0
    """Radius of the sphere."""
    tip_radius_mm: (
        Annotated[float, Within(0.0, 1000.0, "a larger tip is a plane: leave the key out")] | None
    ) = None
    """Radius of the probes' tips; flat where it is None."""

    @property
    def matrix_sigma(self) -> float:
        """Standard deviation of the nine elements of S, where (1 + S) p is read instead of p."""
        return self.external_u_um / self.range_mm * 1e-3

    @model_validator(mode="after")
    def _independent(self) -> Self:
        if self.probes is not None:
            directions = np.array(self.probes, float)
            lengths = np.linalg.norm(directions, axis=1)
            if lengths.min() == 0.0 or abs(np.linalg.det(directions / lengths[:, None])) < 0.05:
                raise ValueError(
                    f"found the directions {[list(d) for d in self.probes]}, expected three that "
                    "do not lie in one plane; correct probes"
                )
        return self


class Nest(Record):
    """The probes and their readings of a sphere whose centre is at p in their frame.

    Readings are the coordinates p, or, with n_k the direction from the sphere to probe k and D the
    sum of the radii of sphere and tip, those of the probes::

        l_k = n_k . p                                                  (flat tip)
        l_k = n_k . p + sqrt(D^2 - |p|^2 + (n_k . p)^2) - D            (spherical tip)
    """

    directions: np.ndarray | None
    """Unit vectors n_k (3, 3), row by row; None for coordinates."""
    distance: float | None
    """D, m; None for flat tips."""

    @classmethod
    def of(cls, settings: NestSettings) -> Self:
        """The probes that settings name."""
        directions = None
        if settings.probes is not None:
            directions = np.array(settings.probes, float)
            directions /= np.linalg.norm(directions, axis=1, keepdims=True)
        tip = settings.tip_radius_mm
        return cls(
            directions=directions,
            distance=None if tip is None else (settings.sphere_radius_mm + tip) * 1e-3,
        )

    @property
    def coordinates(self) -> bool:
        """Whether the readings are coordinates of the sphere."""
        return self.directions is None

    @property
    def readings(self) -> tuple[str, ...]:
        """Names of the three readings."""
        return tuple(name.removesuffix("_mm") for name in self.columns)

    @property
    def columns(self) -> tuple[str, ...]:
        """Columns of the three readings."""
        return COORDINATES if self.coordinates else PROBES

    def read(self, p: Vector) -> list[Scalar]:
        """The three readings of a sphere at p, m."""
        if self.directions is None:
            return list(p.parts)
        along = [Vector.of(n).dot(p) for n in self.directions]
        if self.distance is None:
            return along
        square = p.dot(p)
        return [a + jnp.sqrt(self.distance**2 - square + a * a) - self.distance for a in along]

    def along(self, p: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
        """Change of the readings by small displacements p, m."""
        return p if self.directions is None else p @ self.directions.T

    def measured(self, table: Mapping[str, np.ndarray]) -> Float[np.ndarray, "n 3"]:
        """Readings in a table, m."""
        return np.column_stack([table[name] for name in self.columns]) * 1e-3

    def to_table(self, readings: Float[np.ndarray, "n 3"]) -> dict[str, np.ndarray]:
        """Columns of readings."""
        return {name: readings[:, i] * 1e3 for i, name in enumerate(self.columns)}


class PlaceOfRuns(Effect):
    """A position that differs in every run: three parameters with flat priors per run, on the ports
    of a group.
    """

    kind = "nuisance"
    where = "instrument"
    group: ClassVar[str]
    runs: tuple[int, ...] = ()

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        return tuple(Parameter(f"{run}.{c}", "um", scale=100.0) for run in self.runs for c in "XYZ")

    def response(self, plan: Plan, shape: Mapping[str, Array]) -> Response:
        index = plan.groups["run"]
        return {
            (f"{self.group}.{c}", f"{run}.{c}"): (index == run) * 1.0
            for run in self.runs
            for c in "XYZ"
        }


def reading_columns(settings: NestSettings) -> list[Column]:
    """Columns of the readings, within the range of the probes."""
    names: Sequence[str] = COORDINATES if settings.probes is None else PROBES
    limit = settings.range_mm
    return [Column(name=name, low=-limit, high=limit) for name in names]
