"""The budget of the publication, influence by influence, at any point of the beam.

Every figure is computed twice: from what is known, without rounding, and in the way of the
publication, which rounds every influence to two decimals before it adds them up.
"""

import math
from dataclasses import dataclass
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Float

from ...distributions import Inputs, Normal, Uniform
from ...instruments.laser_frame import filter_shift, safe_filter_shift
from ...numerics.arrays import Array
from ...uncertainty import Budget, propagate

SIGMAS = 3.0**0.5
"""Half-width of a rectangular distribution in standard deviations, eq. (3)."""


class TableOne(NamedTuple):
    """Repeatability of the tool interface: a standard deviation of n repeats, um."""

    sd: float
    n: int
    printed: float

    @property
    def u(self) -> float:
        """Of the mean, eq. (1)."""
        return self.sd / math.sqrt(self.n)


@dataclass(frozen=True)
class Facts:
    """What the publication knows of its set-up; lengths in m unless said."""

    alpha: float = 1.7
    """Expansion of invar, um/(m K)."""
    alpha_share: float = 0.25
    """How far it may be off (Bryan 1968)."""
    head: float = 0.193
    head_half: float = 0.05e-3
    head_change: float = 2.0
    """Largest change of its temperature, K."""
    sensor: float = 0.25
    """Half-width of the sensor's error, K."""
    chain: float = 0.1
    """Half-width of the measuring chain's error, K."""
    frame: float = 0.066
    """Invar between the rods and the prisms along X: two carriers of 18 mm, a mount of 30 mm."""
    frame_change: float = 1.7
    """K."""
    axial: TableOne = TableOne(0.27, 25, 0.05)
    radial: TableOne = TableOne(0.21, 27, 0.04)
    rotational: TableOne = TableOne(0.26, 7, 0.10)
    """At the longest lever of the diode, 26.2 mm."""
    resolution: float = 0.1
    """Half-width, um."""
    deflection: float = 1.0 / 3.0
    """Bending of the beam at 0.7 K/m over its length squared, um/m2 (Jatzkowski 2011), eq. (6)."""
    longest: float = 1.5
    """Length of beam for which the largest bending is stated."""
    filter: float = 5e-3
    """Thickness of the filter."""
    glass: float = 1.5
    """Its refractive index, which the publication does not print: of common glass."""
    psd: float = 10e-3
    """Length of the diode."""
    segment: float = 0.4
    """The longest segment: with the diode's length, the steepest beam."""
    turned: float = 100e-6 + 10e-6
    """Change of the angle of the head: thermal, and of the tool interface, rad."""
    linearity: float = 1e-3
    """Linearity deviation over the measuring range, from one end to the other."""
    repeatability: float = 0.05
    """Of the instrument that calibrated the diode, um."""


PSD_RANGES: dict[tuple[int, str], tuple[float, float, float]] = {
    (1, "X"): (0.20, 0.4, 0.13),
    (1, "Z"): (0.30, 0.6, 0.18),
    (2, "Y"): (0.20, 0.4, 0.13),
    (2, "Z"): (0.60, 1.2, 0.35),
    (3, "X"): (0.20, 0.4, 0.13),
    (3, "Z"): (0.30, 0.6, 0.18),
    (4, "Y"): (0.25, 0.5, 0.15),
    (4, "Z"): (0.35, 0.7, 0.21),
    (5, "X"): (1.3, 2.6, 0.75),
    (5, "Y"): (0.6, 1.2, 0.35),
}
"""Table 2: half of the measuring range (mm) per segment and direction; the linearity deviation and
the uncertainty that are printed for it (um).
"""


class Figure(NamedTuple):
    """One printed figure of the budget, and what comes out here."""

    quantity: str
    published: float
    exact: float
    """Without rounding."""
    rounded: float
    """With the publication's own roundings on the way."""
    digits: int
    """Decimals that are printed."""
    unit: str = "um"
    note: str = ""


def point_budget(place_mm: float, path_m: float, facts: Facts = Facts()) -> Budget:
    """Uncertainty of one reading (um) by the GUM, inputs and all.

    `place_mm` is where the beam meets the diode in that direction, `path_m` how far from the source
    the point is. The head's growth is corrected with its measured temperature, eq. (5); what is
    left of it here is the uncertainty of the correction. Bending of the beam and refraction are not
    corrected: zero, with the largest they may be. The bending is taken as a standard uncertainty,
    as the publication does.
    """
    f = facts
    growth = f.frame * f.alpha * f.frame_change
    bend = f.deflection * path_m**2
    off = f.linearity * abs(place_mm) * 1e3
    inputs: dict[str, Uniform | Normal] = {
        "refraction": _half(refraction(f)),
        "resolution": _half(f.resolution),
        "frame": _half(growth),
        "head alpha": _half(f.alpha_share * f.alpha, f.alpha),
        "head length": _half(f.head_half, f.head),
        "head sensor": _half(f.sensor),
        "head chain": _half(f.chain),
        "tool interface": Normal(0.0, f.rotational.u, dof=f.rotational.n - 1),
        "psd repeatability": Normal(0.0, f.repeatability),
    }
    if bend > 0.0:
        inputs["deflection"] = Normal(0.0, bend)
    if off > 0.0:
        inputs["psd linearity"] = _half(off)

    def reading(x):
        temperature = f.head_change + x["head sensor"] + x["head chain"]
        corrected = x["head length"] * x["head alpha"] * temperature
        rest = ("refraction", "resolution", "frame", "tool interface", "psd repeatability")
        rest += tuple(name for name in ("deflection", "psd linearity") if name in inputs)
        return corrected + sum(x[name] for name in rest)

    return propagate(reading, Inputs(inputs), coverage=0.95)


def point_parts(
    place_mm: Float[Array, "*n"], path_m: Float[Array, "*n"], facts: Facts = Facts()
) -> dict[str, Float[Array, "*n"]]:
    """Standard uncertainties (um) of the inputs of `point_budget`, in functions that can be
    differentiated by the place.
    """
    return {
        **{name: u * jnp.ones_like(path_m) for name, u in same_parts(facts).items()},
        "deflection": facts.deflection * path_m**2,
        "psd linearity": facts.linearity * jnp.abs(place_mm) * 1e3 / SIGMAS,
    }


def same_parts(facts: Facts = Facts()) -> dict[str, float]:
    """Those of `point_parts` that are the same at every point, um."""
    f = facts
    return {
        "refraction": refraction(f) / SIGMAS,
        "resolution": f.resolution / SIGMAS,
        "frame": f.frame * f.alpha * f.frame_change / SIGMAS,
        "head alpha": f.head * f.alpha_share * f.alpha * f.head_change / SIGMAS,
        "head length": f.head_half * f.alpha * f.head_change / SIGMAS,
        "head sensor": f.head * f.alpha * f.sensor / SIGMAS,
        "head chain": f.head * f.alpha * f.chain / SIGMAS,
        "tool interface": f.rotational.u,
        "psd repeatability": f.repeatability,
    }


def point_u(
    place_mm: Float[Array, "*n"], path_m: Float[Array, "*n"], facts: Facts = Facts()
) -> Float[Array, "*n"]:
    """Standard uncertainty (um) of a reading: the root of the sum of squares of `point_parts`."""
    return jnp.sqrt(sum(u * u for u in point_parts(place_mm, path_m, facts).values()))


def refraction(facts: Facts = Facts()) -> float:
    """Safe bound of the change of the shift in the filter, eq. (10), um."""
    slope = facts.psd / facts.segment
    with jax.ensure_compile_time_eval():  # a number also where a design is being traced
        return float(safe_filter_shift(slope, facts.turned, facts.filter)) * 1e6


def refraction_by_snell(facts: Facts = Facts()) -> float:
    """The same with the glass of eq. (9) in it, by Snell's law, um."""
    slope = facts.psd / facts.segment
    steeper = math.tan(math.atan(slope) + facts.turned)
    after, before = (filter_shift(s, 0.0, facts.filter, facts.glass)[0] for s in (steeper, slope))
    return float(after - before) * 1e6


def figures(facts: Facts = Facts()) -> tuple[Figure, ...]:
    """Every figure of the publication's budget."""
    f, found, same, roughly = facts, [], same_parts(facts), rounded_parts(facts)

    def add(
        quantity: str,
        published: float,
        exact: float,
        digits: int = 2,
        unit: str = "um",
        note: str = "",
        rounded: float | None = None,
    ) -> None:
        rounded = shown(exact, digits) if rounded is None else rounded
        found.append(Figure(quantity, published, exact, rounded, digits, unit, note))

    add("expansion of invar, half-width", 0.43, f.alpha_share * f.alpha, unit="um/(m K)")
    add("head: initial length", 1e-4, same["head length"], 4)
    add("head: coefficient of expansion", 0.10, same["head alpha"], rounded=roughly["head alpha"])
    add("head: temperature sensor", 0.05, same["head sensor"])
    add("head: temperature measuring chain", 0.02, same["head chain"])
    for name in ("axial", "radial", "rotational"):
        one: TableOne = getattr(f, name)
        add(f"tool interface, {name}", one.printed, one.u)
    add("frame", 0.12, same["frame"], rounded=roughly["frame"],
        note="printed from 0.12 um/K; 66 mm at 1.7 um/(m K) are 0.112 um/K")  # fmt: skip
    add("resolution", 0.06, same["resolution"])
    add("deflection of the beam at 1.5 m", 0.75, f.deflection * f.longest**2)
    add("steepest beam", 25.0, 1e3 * f.psd / f.segment, 0, "mrad")
    add("refraction in the filter, half-width", 0.55, refraction(f),
        note=f"without the glass; with it, {refraction_by_snell(f):.2f} um")  # fmt: skip
    add("refraction in the filter", 0.32, same["refraction"], rounded=roughly["refraction"])
    for (segment, axis), (half, deviation, printed) in PSD_RANGES.items():
        where = f"segment {segment} {axis}"
        add(f"linearity deviation, {where}", deviation, f.linearity * 2.0 * half * 1e3, 1)
        add(f"diode, {where}", printed, psd_u(half, f))
    whole, exact = shown(combined(f), 2), float(point_budget(1.3, f.longest, f).u[0])
    add("combined, largest", 1.13, exact, rounded=whole)
    add("expanded (k = 2), largest", 2.26, 2.0 * exact, rounded=2.0 * whole,
        note="printed: twice the rounded 1.13; unrounded, 2.25")  # fmt: skip
    return tuple(found)


def shown(value: float, digits: int = 0) -> float:
    """A positive value as it would be printed: half a unit of the last digit rounds up."""
    return math.floor(value * 10.0**digits + 0.5 + 1e-9) / 10.0**digits


def psd_u(half_mm: float, facts: Facts = Facts()) -> float:
    """Uncertainty of the diode where the beam is `half_mm` from its middle, eq. (11), um."""
    return math.hypot(facts.linearity * half_mm * 1e3 / SIGMAS, facts.repeatability)


def rounded_parts(facts: Facts = Facts()) -> dict[str, float]:
    """The nine influences of Table 3 at their largest, each rounded as the publication does, um."""
    f, same = facts, same_parts(facts)
    nine = {
        "refraction": shown(refraction(f), 2) / SIGMAS,
        "resolution": same["resolution"],
        # 0.12 um/K as printed; 66 mm of invar make 0.112.
        "frame": 0.12 * f.frame_change / SIGMAS,
        "head alpha": f.head * shown(f.alpha_share * f.alpha, 2) * f.head_change / SIGMAS,
        "head sensor": same["head sensor"],
        "head chain": same["head chain"],
        "tool interface": f.rotational.u,
        "deflection": f.deflection * f.longest**2,
        "psd": psd_u(1.3, f),
    }
    return {name: shown(u, 2) for name, u in nine.items()}


def combined(facts: Facts = Facts()) -> float:
    """Largest combined uncertainty from the nine influences of Table 3, each rounded first, um."""
    return math.sqrt(sum(u**2 for u in rounded_parts(facts).values()))


def _half(width: float, middle: float = 0.0) -> Uniform:
    return Uniform(middle - width, middle + width)
