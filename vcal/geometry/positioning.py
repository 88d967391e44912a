"""Evaluation of positioning tests of one axis: ISO 230-2:2014, with uncertainties.

With the deviations x_ij of the measured from the target position i in run j, for the approach in
the positive direction (``+``) and in the negative one (``-``), n runs each::

    mean_i+  = (1/n) sum_j x_ij+                              mean unidirectional deviation
    s_i+     = sqrt(sum_j (x_ij+ - mean_i+)^2 / (n - 1))      its standard uncertainty
    mean_i   = (mean_i+ + mean_i-) / 2                        mean bidirectional deviation
    B_i      = mean_i+ - mean_i-,   B = max |B_i|             reversal error
    B_mean   = (1/m) sum_i B_i
    R_i+     = 4 s_i+,              R+ = max R_i+             unidirectional repeatability
    R_i      = max(2 s_i+ + 2 s_i- + |B_i|, R_i+, R_i-),  R = max R_i
    E+       = max mean_i+ - min mean_i+                      systematic error, unidirectional
    E        = max(mean_i+, mean_i-) - min(mean_i+, mean_i-)  ... bidirectional
    M        = max mean_i - min mean_i                        mean bidirectional systematic error
    A+       = max(mean_i+ + 2 s_i+) - min(mean_i+ - 2 s_i+)  accuracy, unidirectional
    A        = max(mean_i+ + 2 s_i+, mean_i- + 2 s_i-) - min(mean_i+ - 2 s_i+, mean_i- - 2 s_i-)

Uncertainties have the contributors of ISO/TR 230-9:2005 and of ISO 230-2:2014, annex A: measuring
device, misalignment, temperature and expansion coefficient of the compensation, and environmental
variation. All but the last are in proportion to the distance L between the two positions that
determine a quantity (here: the length of the test)::

    u_L^2 = L^2 (u_device^2 + u_misalignment^2 + alpha^2 u(T)^2 + (T - 20 degC)^2 u(alpha)^2)

The environment adds an independent deviation to every reading, uniform over the range E_VE of a
drift test: u_e = E_VE / sqrt(12). By the law of propagation (JCGM 100:2008, 5.1), with u(s) = u_e /
sqrt(2 (n - 1)), the scatter of an estimated standard deviation that is due to the environment
alone::

    u^2(M)  = u_L^2 + u_e^2 / n
    u^2(E)  = u_L^2 + 2 u_e^2 / n                     also E+, E-
    u^2(A)  = u_L^2 + 2 u_e^2 / n + 8 u(s)^2          also A+, A-
    u^2(B)  = 2 u_e^2 / n,   u^2(B_mean) = 2 u_e^2 / (n m)
    u(R+)   = 4 u(s)                                  also R-
    u^2(R)  = 8 u(s)^2 + 2 u_e^2 / n

U = 2 u (k = 2). These coefficients are derived for any number n of runs; the tables of the
standards, for n = 5, were not available for a comparison. That uncertainties are those of ISO/TR
230-9:2005, annex C, and annex A is their estimation, is in the public abstract of ISO 230-2:2014
(https://ecommerce.inn.cl/iso-230-2201448564). Deviations may be in any unit; the results are in the
same one.
"""

import math
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float

COVERAGE = 2.0
"""Coverage factor k of all expanded uncertainties."""
QUANTITIES = ("A", "A+", "A-", "R", "R+", "R-", "E", "E+", "E-", "M", "B", "B_mean")
"""Results of a bidirectional test, in the order in which they are reported."""
_SYSTEMATIC = ("E", "E+", "E-", "M", "B", "B_mean")


@dataclass(frozen=True)
class Contributors:
    """Standard uncertainties of a positioning test, besides its own scatter."""

    device: float = 0.0
    """Of the scale of the measuring device, m/m."""
    misalignment: float = 0.0
    """Of the slope by misalignment, m/m."""
    temperature: float = 0.0
    """Of the temperature of the material, K."""
    expansion: float = 0.0
    """Expansion coefficient alpha of the compensation, 1/K."""
    expansion_u: float = 0.0
    """Its standard uncertainty, 1/K."""
    away: float = 0.0
    """Mean of the temperature of the material minus 20 degC, K."""
    environment: float = 0.0
    """Range E_VE of a drift test, in the unit of the deviations."""

    def in_proportion(self) -> dict[str, float]:
        """Standard uncertainties per length of the test, by contributor."""
        return {
            "device": self.device,
            "misalignment": self.misalignment,
            "temperature": abs(self.expansion) * self.temperature,
            "expansion": abs(self.away) * self.expansion_u,
        }


@dataclass(frozen=True)
class Positioning:
    """Results of one test, in the unit of its deviations."""

    target: Float[np.ndarray, " m"]
    """Target positions."""
    mean_up: Float[np.ndarray, " m"]
    """Mean deviation at each, approached in the positive direction; nan without such runs."""
    mean_down: Float[np.ndarray, " m"]
    """The same for the negative direction."""
    s_up: Float[np.ndarray, " m"]
    """Standard deviation of the runs; nan for a single run."""
    s_down: Float[np.ndarray, " m"]
    reversal: Float[np.ndarray, " m"]
    """B_i."""
    repeatability: Float[np.ndarray, " m"]
    """R_i; of a unidirectional test R_i+ or R_i-."""
    runs: int
    """Number n of runs in each direction, the least of all positions."""
    values: dict[str, float]
    """Those of the `QUANTITIES` that the runs determine, by name."""
    u: dict[str, float] = field(default_factory=dict)
    """Their standard uncertainties."""

    def U(self, name: str) -> float:
        """Expanded uncertainty (k = 2) of a quantity."""
        return COVERAGE * self.u[name]


def positioning(
    target: Float[np.ndarray, " m"],
    up: Float[np.ndarray, "m n"] | None = None,
    down: Float[np.ndarray, "m n"] | None = None,
    contributors: Contributors | None = None,
    *,
    length: float | None = None,
) -> Positioning:
    """Evaluate a positioning test by ISO 230-2:2014.

    `target` are the m target positions; `up` and `down` the deviations (m, n) of the runs in the
    positive and negative direction, NaN where a run lacks a position; one of them may be missing, a
    unidirectional test. `length` is the length L of the test in the unit of the deviations, by
    default the range of the targets, which are then in that unit too.

    Raises `ValueError` for no runs at all, for arrays of other shapes, and for a position without
    any deviation in a direction that was tested.
    """
    target = np.asarray(target, float)
    tested = {"+": up, "-": down}
    given = {way: np.asarray(x, float) for way, x in tested.items() if x is not None}
    if not given:
        raise ValueError("found no runs, expected deviations in one direction at least")
    for x in given.values():
        if x.ndim != 2 or len(x) != len(target):
            raise ValueError(
                f"found deviations of shape {x.shape}, expected ({len(target)}, runs), one row for "
                "every target position"
            )
        if np.isnan(x).all(1).any():
            raise ValueError(
                f"found no deviation at the target {target[int(np.argmax(np.isnan(x).all(1)))]:g}, "
                "expected one in every direction that was tested"
            )
    none = np.full(len(target), np.nan)
    mean = {way: np.nanmean(given[way], axis=1) if way in given else none for way in "+-"}
    s = {way: _scatter(given[way]) if way in given else none for way in "+-"}
    counts = {way: (~np.isnan(x)).sum(1) for way, x in given.items()}
    runs = int(min(count.min() for count in counts.values()))
    values: dict[str, float] = {}
    for way in given:
        values[f"E{way}"] = float(np.ptp(mean[way]))
        if runs > 1:
            values[f"R{way}"] = float((4.0 * s[way]).max())
            high, low = mean[way] + 2.0 * s[way], mean[way] - 2.0 * s[way]
            values[f"A{way}"] = float(high.max() - low.min())
    reversal, repeatability = none, 4.0 * np.fmax(s["+"], s["-"])
    if len(given) == 2:
        reversal = mean["+"] - mean["-"]
        both = np.stack([mean["+"], mean["-"]])
        values["E"] = float(np.ptp(both))
        values["M"] = float(np.ptp(both.mean(0)))
        values["B"] = float(np.abs(reversal).max())
        values["B_mean"] = float(reversal.mean())
        if runs > 1:
            spread = 2.0 * np.stack([s["+"], s["-"]])
            repeatability = np.maximum(spread.sum(0) + np.abs(reversal), 2.0 * spread.max(0))
            values["R"] = float(repeatability.max())
            values["A"] = float((both + spread).max() - (both - spread).min())
    found = contributors or Contributors()
    at = float(np.ptp(target)) if length is None else length
    return Positioning(
        target=target,
        mean_up=mean["+"],
        mean_down=mean["-"],
        s_up=s["+"],
        s_down=s["-"],
        reversal=reversal,
        repeatability=repeatability,
        runs=runs,
        values={name: values[name] for name in QUANTITIES if name in values},
        u=_uncertainties(found, at, runs, len(target), tuple(values)),
    )


def runs_at_targets(
    x: Float[np.ndarray, " n"],
    direction: Float[np.ndarray, " n"],
    deviation: Float[np.ndarray, " n"],
    *,
    apart: float,
) -> tuple[np.ndarray, np.ndarray | None, np.ndarray | None]:
    """Target positions (m,) and the deviations (m, runs) in both directions from single readings.

    Positions `x` (n,) that differ by less than `apart` are one target. `direction` is +1 or -1. A
    target that was reached in one direction only is left out where others were in both. Deviations
    are NaN in runs that lack a target; a direction without any is None.
    """
    order = np.argsort(x, kind="stable")
    group = np.empty(len(x), int)
    group[order] = np.cumsum(np.diff(x[order], prepend=x[order[0]]) > apart)
    ways = [way for way in (1.0, -1.0) if (direction == way).any()]
    reached = [{*group[direction == way].tolist()} for way in ways]
    kept = sorted(set.intersection(*reached)) or sorted(set.union(*reached))
    found: dict[float, np.ndarray] = {}
    for way in ways:
        rows = [np.flatnonzero((group == g) & (direction == way)) for g in kept]
        table = np.full((len(kept), max(len(r) for r in rows)), np.nan)
        for i, r in enumerate(rows):
            table[i, : len(r)] = deviation[r]
        if not np.isnan(table).all(1).any():
            found[way] = table
    target = np.array([x[group == g].mean() for g in kept])
    return target, found.get(1.0), found.get(-1.0)


def _scatter(x: Float[np.ndarray, "m n"]) -> Float[np.ndarray, " m"]:
    """Standard deviations (m,) over the runs; nan where there is one run only."""
    count = (~np.isnan(x)).sum(1)
    squares = np.nansum((x - np.nanmean(x, axis=1, keepdims=True)) ** 2, axis=1)
    return np.sqrt(np.where(count > 1, squares / np.maximum(count - 1, 1), np.nan))


def _uncertainties(
    found: Contributors, length: float, n: int, m: int, names: tuple[str, ...]
) -> dict[str, float]:
    """Standard uncertainties of the quantities in `names`; see the module."""
    along = length**2 * sum(u**2 for u in found.in_proportion().values())
    e = found.environment**2 / 12.0
    s = e / (2.0 * (n - 1)) if n > 1 else math.inf
    squares = {
        "M": along + e / n,
        **dict.fromkeys(("E", "E+", "E-"), along + 2.0 * e / n),
        **dict.fromkeys(("A", "A+", "A-"), along + 2.0 * e / n + 8.0 * s),
        "B": 2.0 * e / n,
        "B_mean": 2.0 * e / (n * m),
        **dict.fromkeys(("R+", "R-"), 16.0 * s),
        "R": 8.0 * s + 2.0 * e / n,
    }
    return {name: math.sqrt(squares[name]) for name in QUANTITIES if name in names}


def systematic(
    up: Float[np.ndarray, " m"] | None, down: Float[np.ndarray, " m"] | None
) -> dict[str, Float[np.ndarray, " k"]]:
    """The systematic quantities (E, E+, E-, M, B, B_mean) as linear functions of mean deviations:
    weights (k,) of the deviations `up` (m,), then `down` (m,), whichever are given.

    The value of a quantity is the weights times the deviations; where it is a range or a largest
    magnitude, the weights are those of the positions that determine it.
    """
    parts = [np.asarray(x, float) for x in (up, down) if x is not None]
    both, m = np.concatenate(parts), len(parts[0])
    found: dict[str, np.ndarray] = {}
    eye = np.eye(len(both))
    for k, (way, x) in enumerate(zip("+-", (up, down), strict=True)):
        if x is not None:
            at = m * (k if len(parts) == 2 else 0)
            found[f"E{way}"] = eye[at + int(np.argmax(x))] - eye[at + int(np.argmin(x))]
    if len(parts) == 2:
        found["E"] = eye[int(np.argmax(both))] - eye[int(np.argmin(both))]
        middle, reversal = 0.5 * (parts[0] + parts[1]), parts[0] - parts[1]
        mean = 0.5 * (eye[:m] + eye[m:])
        found["M"] = mean[int(np.argmax(middle))] - mean[int(np.argmin(middle))]
        each = eye[:m] - eye[m:]
        at = int(np.argmax(np.abs(reversal)))
        found["B"] = each[at] * (1.0 if reversal[at] >= 0.0 else -1.0)
        found["B_mean"] = each.mean(0)
    return {name: found[name] for name in _SYSTEMATIC if name in found}
