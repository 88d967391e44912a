"""What is asked of a machine, as linear functionals of its parameters and of readings.

An error is judged as the publication gives it: a straightness less its least-squares line, a roll
less its mean, a positioning error as half its change over the travel, a squareness with the slopes
of the straightnesses in its plane.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from ...effects.geometric import GeometricErrors, LocationError
from ...machine.chain import Chain
from ...machine.ports import PortLayout
from ...model.forward import Model, tool_points_with_jacobian
from ...numerics.arrays import Array
from ...uncertainty.outputs import Field, Output
from ...uncertainty.quantities import Measure, Pair, Quantity, State
from .recipe import PLANES, SIGNS, Recipe, less_line, line
from .setting import POSITIONING, ROLLS, SQUARENESSES, THIRTEEN, TRAVEL

NODES = 11
"""Places along an axis at which an error is judged."""
CORNERS = 3
"""Places along every axis at which the tool is judged: ends and middle."""
_MICRO = 1e-6


@dataclass(frozen=True)
class Asked:
    """The thirteen errors at places along their axes, one output after the other."""

    x: Mapping[str, Float[np.ndarray, " n"]]
    """Places by error, m; a single NaN for one that has none."""

    @classmethod
    def usual(cls) -> "Asked":
        """Evenly spaced over the travel."""
        single = (*POSITIONING, *SQUARENESSES)
        every = {n: np.full(1, np.nan) for n in THIRTEEN}
        return cls(
            every | {n: np.linspace(*TRAVEL[n[2]], NODES) for n in THIRTEEN if n not in single}
        )

    @classmethod
    def by(cls, evaluation: Recipe) -> "Asked":
        """Where an evaluation beam by beam has them."""
        own = np.asarray(evaluation.names)
        return cls({n: evaluation.x[own == n] for n in THIRTEEN})

    @property
    def names(self) -> tuple[str, ...]:
        """The error of every output."""
        return tuple(n for n in THIRTEEN for _ in self.x[n])

    def of(
        self, model: Model, beside: Mapping[str, tuple[str, float]] | None = None
    ) -> Float[np.ndarray, "q k"]:
        """The outputs (m or rad) per amplitude of a model, in solver units.

        `beside` adds to a straightness another error times a lever (m): where the straightness is
        that of a line away from the axis. An error that the model does not have is zero.
        """
        table, beside = _Table(model), beside or {}

        def rows(name: str) -> np.ndarray:
            x = self.x[name]
            if name in POSITIONING:
                ends = table.values(name, np.array(TRAVEL[name[2]]))
                return 0.5 * (ends[1:] - ends[:1])
            if name in SQUARENESSES:
                slopes = np.zeros((1, table.size))
                for along, across in (PLANES[name], PLANES[name][::-1]):
                    motion = f"E{across}{along}"
                    at = self.x[motion]
                    slopes += line(at)[1:] @ table.values(motion, at)
                return table.values(name, x) + SIGNS[name] * slopes
            values = table.values(name, x)
            if name in ROLLS:
                return values - values.mean(0)
            if name in beside:
                other, lever = beside[name]
                values = values + lever * table.values(other, x)
            return less_line(x, values)

        return np.concatenate([rows(name) for name in THIRTEEN])

    def tool(self, chain: Chain, outputs: Float[np.ndarray, "q k"]) -> Float[np.ndarray, "3n k"]:
        """Displacement of the tool (m) at `places` that the outputs make, per anything they are
        given by: parameters, or readings.
        """
        at = places()
        layout = PortLayout.of(chain.axes, ())
        still = np.zeros((len(at), len(layout)))
        _, slopes = tool_points_with_jacobian(chain, jnp.asarray(at), jnp.asarray(still))
        slopes, order = np.asarray(slopes), np.asarray(self.names)
        found = np.zeros((len(at), 3, outputs.shape[1]))
        for name in THIRTEEN:
            own, x = outputs[order == name], at[:, "XYZ".index(name[-1])]
            if name in SQUARENESSES:
                columns = LocationError.of(chain, name, 1.0).column
                ports = [(port, factor * x[:, None] * own) for port, factor in columns]
            elif name in POSITIONING:
                low, high = TRAVEL[name[2]]
                ports = [(name, ((2.0 * x - low - high) / (high - low))[:, None] * own)]
            else:
                nearest = np.abs(x[:, None] - self.x[name]).argmin(1)
                ports = [(name, own[nearest])]
            for port, values in ports:
                found += slopes[:, :, layout.index(port)][:, :, None] * values[:, None, :]
        return found.reshape(3 * len(at), outputs.shape[1])


def places() -> Float[np.ndarray, "n 3"]:
    """Axis positions in the volume at which the tool is judged, m."""
    sides = [np.linspace(*TRAVEL[axis], CORNERS) for axis in "XYZ"]
    return np.stack(np.meshgrid(*sides, indexing="ij"), -1).reshape(-1, 3)


class _Table:
    """Error motions and squarenesses of a model by name, per amplitude in solver units."""

    def __init__(self, model: Model):
        self.size = len(model.entries)
        self.steps = np.array([e.parameter.step for e in model.entries])
        self.motions, self.locations = {}, {}
        for effect, place in zip(model.effects, model.places, strict=True):
            if isinstance(effect, GeometricErrors):
                k = place.start
                for m in effect.motions:
                    self.motions[m.name] = m, k
                    k += len(m.basis.labels)
                for e in effect.locations:
                    self.locations[e.name] = k
                    k += 1

    def values(self, name: str, x: Float[np.ndarray, " n"]) -> Float[np.ndarray, "n k"]:
        found = np.zeros((len(x), self.size))
        if name in self.motions:
            motion, k = self.motions[name]
            functions = np.asarray(motion.basis.functions(jnp.asarray(x)))
            own = slice(k, k + functions.shape[1])
            found[:, own] = functions * self.steps[own]
        elif name in self.locations:
            k = self.locations[name]
            found[:, k] = self.steps[k]
        return found


class LinearErrors(eqx.Module, Quantity):
    """Estimate less truth of linear functionals, um and urad, as a field `name`.

    The estimate comes from the identified parameters, or from the readings.
    """

    name: str = eqx.field(static=True)
    true: Float[np.ndarray, "q k"]
    """Of the true amplitudes, solver units."""
    found: Float[np.ndarray, "q l"] | None = None
    """Of the identified ones."""
    readings: Float[np.ndarray, "q nm"] | None = None

    def measure(self, pair: Pair) -> Measure:
        return _LinearErrors(self.name, self.true, self.found, self.readings)


class _LinearErrors(Measure):
    name: str = eqx.field(static=True)
    true: np.ndarray
    found: np.ndarray | None
    readings: np.ndarray | None

    @property
    def outputs(self) -> tuple[Output | Field, ...]:
        return (Field(self.name, (len(self.true),)),)

    def __call__(self, state: State) -> dict[str, Array]:
        value = -self.true @ state.true if self.true.shape[1] else jnp.zeros(len(self.true))
        if self.found is not None:
            value += self.found @ state.found
        if self.readings is not None:
            if state.readings is None:
                raise ValueError(
                    f"{self.name}: found no readings, expected them, as it is an evaluation of "
                    "readings; a campaign can have it, its linearisation cannot"
                )
            value += self.readings @ state.readings.reshape(-1)
        return {self.name: value / _MICRO}
