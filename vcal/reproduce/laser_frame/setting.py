"""The demonstrator, its errors and what the publication prints; what it leaves out is assumed here.

Printed: the chain, the travel that the beams cover, 7 + 4 x 11 points, the thirteen errors, the
ranges of the diode (`budget.PSD_RANGES`). Not printed: which edges of the work space the beams run
along, where on its legs the frame leaves the travel, the functions that the errors are drawn from
and their sizes.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from ...effects.base import Effect, Response
from ...effects.geometric import ErrorMotion, GeometricErrors, LocationError
from ...instruments.laser_frame import LaserFrame, Segment, beam_path
from ...machine.chain import Chain, chain_from_string
from ...machine.error_functions import Legendre
from ...machine.parameters import Parameter
from ...machine.plan import Plan
from ...numerics.arrays import Array
from .budget import PSD_RANGES, Facts, point_u

CHAIN = "w b X Y Z t"
TRAVEL: Mapping[str, tuple[float, float]] = {"X": (0.0, 0.184), "Y": (0.0, 0.167), "Z": (0.0, 0.35)}
"""Of the demonstrator, m."""
LEGS: Mapping[str, float] = {"X": 0.35, "Y": 0.32, "Z": 0.40}
"""Sides of the volume that the beam borders, m; the travel is taken to lie in their middle."""
LEVER_M = 26.2e-3
"""Longest lever of the diode."""
STRAIGHTNESSES = ("EYX", "EZX", "EXY", "EZY", "EXZ", "EYZ")
POSITIONING = ("EXX", "EYY")
ROLLS = ("EAX", "EBY")
SQUARENESSES = ("EA0Z", "EB0Z", "EC0Y")
THIRTEEN = (*STRAIGHTNESSES, *POSITIONING, *ROLLS, *SQUARENESSES)
OTHERS = ("EZZ", "EBX", "ECX", "EAY", "ECY", "EAZ", "EBZ", "ECZ")
DEGREES: Mapping[str, tuple[int, ...]] = {
    **{name: (2, 3, 4) for name in STRAIGHTNESSES},
    **{name: (1,) for name in POSITIONING},
    **{name: (1, 2, 3, 4) for name in (*ROLLS, *OTHERS)},
}
"""Legendre degrees: a straightness has no slope, which is a squareness or the frame's pose, and
five beams meet two positions of X and of Y only, so that positioning errors have but a slope.
"""
TRANSLATION_UM, ROTATION_URAD = 10.0, 100.0 / 3.0
"""Standard deviation of every coefficient of an error. Three of the rotation are the 100 urad that
the publication takes for its machine as a safe bound.
"""
HEAD_K = 2.0
"""Safe bound of the change of the head's temperature since the reference run."""
WIDE_M = 1e-3
"""Prior that leaves everything to the data, m or rad."""


class ReadingNoise(Effect):
    """Independent noise of every reading, in the sizes given."""

    name = "reading_noise"
    summary = "independent noise of every reading"
    kind = "random"
    where = "instrument"
    u: Float[Array, "n 2"]
    """Standard uncertainty, m."""

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        return tuple(Parameter(f"factor_{c}", "1", sigma=1.0) for c in "uv")

    def response(self, plan: Plan, shape: Mapping[str, Array]) -> Response:
        return {(f"read.{c}", f"factor_{c}"): self.u[:, i] for i, c in enumerate("uv")}


@dataclass(frozen=True)
class Layout:
    """A beam path and the places of the points on it."""

    segments: tuple[Segment, ...]
    shares: tuple[Float[np.ndarray, " p"], ...]
    """Places on every segment: 0 at its start, 1 at its end."""
    lever: float = 0.0
    """From the spindle's axis to the upright diode, m."""

    @classmethod
    def even(cls, segments: Sequence[Segment]) -> "Layout":
        """Evenly spaced points on every segment, ends included."""
        return cls(tuple(segments), tuple(np.linspace(0.0, 1.0, one.points) for one in segments))

    @classmethod
    def named(cls, path: str) -> "Layout":
        """A named beam path of the demonstrator, with the printed ranges of the diode."""
        ranges = {number: range_of(number) for number in range(1, 6)}
        return cls.even(beam_path(path, TRAVEL, ranges))

    @property
    def beams(self) -> list[tuple[Segment, Float[np.ndarray, " p"]]]:
        """Segments with the places on them."""
        return list(zip(self.segments, self.shares, strict=True))

    @property
    def points(self) -> int:
        """Of all segments."""
        return sum(map(len, self.shares))

    @property
    def position(self) -> Float[np.ndarray, "n 3"]:
        """Axis positions of all points, m."""
        return np.concatenate(
            [one.start + s[:, None] * one.length * one.direction for one, s in self.beams]
        )

    def u(self, factor: float = 2.0) -> Float[np.ndarray, "n 2"]:
        """Standard uncertainty of all readings by the budget, m."""
        return np.asarray(reading_u(self.segments, self.shares, factor=factor))


def range_of(number: int) -> tuple[float, float]:
    """Half of the diode's range on a segment of the publication, in both readings, m."""
    u, v = (1e-3 * PSD_RANGES[number, c][0] for c in "XYZ" if (number, c) in PSD_RANGES)
    return u, v


def frame_setup(
    layout: Layout | str = "3d", lever_m: float = 0.0, sigma_m: float = 1e-6
) -> tuple[Chain, LaserFrame, Plan]:
    """The demonstrator with a laser frame (for a name, evenly measured), and the points."""
    if isinstance(layout, str):
        layout = replace(Layout.named(layout), lever=lever_m)
    chain = chain_from_string(CHAIN, TRAVEL)
    instrument = LaserFrame.of(layout.segments, chain, sigma=sigma_m, lever=layout.lever)
    table = {f"{c}_mm": 1e3 * layout.position[:, i] for i, c in enumerate("xyz")}
    counts = [len(s) for s in layout.shares]
    table["segment"] = np.repeat([one.number for one in layout.segments], counts)
    return chain, instrument, instrument.plan(chain, table)


def errors(chain: Chain, names: tuple[str, ...], sigma: Mapping[str, float]) -> GeometricErrors:
    """Error motions and squarenesses by name, every coefficient with the size `sigma[name]` (m or
    rad).
    """
    motions = tuple(
        ErrorMotion(name, name[2], Legendre(TRAVEL[name[2]], DEGREES[name], sigma[name]))
        for name in names
        if name in DEGREES
    )
    locations = tuple(
        LocationError.of(chain, name, sigma[name]) for name in names if name in SQUARENESSES
    )
    return GeometricErrors(motions=motions, locations=locations)


def sizes(
    translation_um: float = TRANSLATION_UM, rotation_urad: float = ROTATION_URAD
) -> dict[str, float]:
    """The standard deviation of the coefficients of every error, m or rad."""
    linear = {n: n[1] in "XYZ" for n in (*THIRTEEN, *OTHERS)}
    return {n: 1e-6 * (translation_um if own else rotation_urad) for n, own in linear.items()}


def reading_u(
    segments: Sequence[Segment],
    shares: Sequence[Float[Array, " p"]],
    *,
    factor: float = 2.0,
    legs: Mapping[str, float] | None = None,
    facts: Facts | None = None,
) -> Float[Array, "n 2"]:
    """Standard uncertainty (m) of all readings by the budget: by where the beam meets the diode,
    and by how far the light has come.

    `shares` are the places of the points on their segments, 0 to 1, segment by segment in the
    order of the beam. `legs` (m) are the sides of the frame; without them `LEGS`. The `factor` two
    is the publication's: "the noise is doubled additionally" for the reference run.
    """
    found = []
    for one, s, path in zip(segments, shares, way_of_light(segments, shares, legs), strict=True):
        both = [
            point_u(1e3 * half * (2.0 * s - 1.0), path, facts or Facts()) * 1e-6
            for half in one.psd_range
        ]
        found.append(jnp.stack(both, -1))
    return factor * jnp.concatenate(found)


def way_of_light(
    segments: Sequence[Segment],
    shares: Sequence[Float[Array, " p"]],
    legs: Mapping[str, float] | None = None,
) -> list[Float[Array, " p"]]:
    """How far the light has come at every point, m, along the legs of the frame (m, or `LEGS`)."""
    legs = LEGS if legs is None else legs
    start, found = 0.0, []
    for one, s in zip(segments, shares, strict=True):
        found.append(start + 0.5 * (legs[one.axis] - one.length) + s * one.length)
        start += legs[one.axis]
    return found
