"""The description of this reproduction: printed numbers, record and page."""

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from ...plots.panels import Mark, Panel, bars, mark, panels
from ...plots.style import AFTER, BEFORE, DOTS, FIELD, INK, MARK, NOMINAL
from ...report import Table, Tile
from ...report.html.text import number, percent
from ...uncertainty.comparison import Comparison
from ..document import Row, picked, table
from ..registry import Reproduction
from .compared import Rung
from .results import CAMPAIGN, INFLUENCES, LEAST, Results
from .setting import AREA_MM, EULER_XYZ_DEG, FINAL_UM, INITIAL_UM, STATION_MM, TESTS
from .trials import KINDS, PARTS, Pooled, Trials

_NOISES = 3
"""Rungs that differ in the noise alone come first."""
_FIRST, _LOUDEST = "noise × 1", "noise × 100"
_EVERY = INFLUENCES["all of these, pose fitted"]


def _of(t: Trials, kind: str) -> Pooled:
    """Distances |d| of one kind of error, over all points and tests, um."""
    return t.pooled[kind, "distance"]


def rows(r: Results) -> list[Row]:
    """All printed numbers, and those that belong beside them."""
    first = next(iter(r.many))
    found = [
        Row("tests", TESTS, float(r.few[first].ensemble.draws), "1", "and a longer campaign"),
        Row("tests, longer campaign", None, float(r.draws), "1"),
    ]
    for t in (r.few[first], r.many[first]):
        p, tests = _of(t, "initial"), f"{t.ensemble.draws} tests"
        note = (
            f"{tests}; standard error of the mean {p.u_mean:.2f} µm. Sizes of the family are found "
            "so that both printed numbers are met"
        )
        found += [
            Row("initial error, mean of |d|", INITIAL_UM[0], p.mean, "um", note),
            Row("initial error, standard deviation of |d|", INITIAL_UM[1], p.sd, "um", tests),
        ]
    mean, sd = FINAL_UM
    for reading, t in [(name, one[name]) for name in r.many for one in (r.few, r.many)]:
        p, note = (
            _of(t, "residual"),
            f"{reading}; {t.ensemble.draws} tests; residual of the readings",
        )
        found += [
            Row("final error, mean of |d|", mean, p.mean, "um", note),
            Row("final error, standard deviation of |d|", sd, p.sd, "um", note),
            Row("final error, root mean square", math.hypot(mean, sd), math.hypot(p.mean, p.sd),
                "um", f"{note}; the printed one from mean and standard deviation"),
            Row("final error, mean + 2 standard deviations", mean + 2.0 * sd, p.mean + 2.0 * p.sd,
                "um", f"{note}; 95 % lie below {p.quantile(0.95):.2f} µm"),
        ]  # fmt: skip
    for reading, t in r.many.items():
        p = _of(t, "left")
        note = (
            f"{reading}; {t.ensemble.draws} tests; true less predicted point, not to be seen in a "
            "workshop"
        )
        found += [
            Row("error left, mean of |d|", None, p.mean, "um", note),
            Row("error left, standard deviation of |d|", None, p.sd, "um", note),
            Row("error left, 95 % lie below", None, p.quantile(0.95), "um", note),
        ]
    failed = sum(t.failed for t in (*r.few.values(), *r.many.values()))
    return [
        *found,
        Row("identifications that failed", None, float(failed), "1"),
        Row("parameters of the machine that the points at Z = 0 can tell apart", None,
            float(r.rank.rank), "1",
            f"of {r.rank.parameters}; {r.rank.silent} change no reading at all"),
    ]  # fmt: skip


def record(r: Results) -> dict[str, Any]:
    """All numbers behind the page, by section."""

    def errors(t: Trials) -> dict[str, Any]:
        found = {kind: _of(t, kind) for kind in KINDS}
        return {k: {**picked(p, "mean", "sd", "u_mean"), "q95": p.quantile(0.95)}
                for k, p in found.items()}  # fmt: skip

    def compared(c: Comparison) -> list[dict[str, Any]]:
        values = {"y": c.value, "u": c.u, "low": c.low, "high": c.high}
        return [
            {"output": label,
             **{way: {key: v[i, k] for key, v in values.items()}
                for k, way in enumerate(("gum", "monte_carlo"))},
             "delta": c.delta[i], "verdict": c.verdicts[i]}
            for i, label in enumerate(c.labels) if np.isfinite(c.delta[i])
        ]  # fmt: skip

    return {
        "setting": asdict(next(iter(r.many.values())).setting),
        "family": asdict(r.search),
        "rank": asdict(r.rank),
        "tests": {name: errors(t) for name, t in r.many.items()},
        "gum_and_monte_carlo": {
            name: {"error_motions": compared(one.motions), "components": compared(one.components),
                   "lengths": [asdict(length) for length in one.lengths],
                   "undefined": list(one.undefined)}
            for name, one in r.rungs.items()
        },
        "influences": {
            name: {**asdict(INFLUENCES[name]), "tests": t.ensemble.draws, **errors(t)}
            for name, t in r.influences.items()
        },
        "probing": asdict(r.probing),
    }  # fmt: skip


def _head(r: Results) -> tuple[str, list[Tile]]:
    one, rank, p = r.rungs[_FIRST], r.rank, _matched(r)
    text = f"""\
The printed final error of {FINAL_UM[0]} µm is matched best by {_best(r)}, which gives
{number(p.mean, 4)} µm; it is the residual of the readings, that is, mostly the tracker's own noise.
Linearised GUM and Monte Carlo were compared for {sum(len(c.labels) for c in one.both)} error
motions and components: {_verdicts(one)}. For the {len(one.undefined)} lengths |d| the GUM has no
first-order uncertainty.
"""
    tiles = [
        Tile("residual, mean |d|", f"{number(_of(r.first, 'residual').mean, 4)} µm",
             f"printed {FINAL_UM[0]} µm"),
        Tile("error left, mean |d|", f"{number(_of(r.first, 'left').mean)} µm",
             "known to a simulation only"),
        Tile("GUM and Monte Carlo", _verdicts(one), "JCGM 101, clause 8, one digit"),
        Tile("rank at Z = 0", f"{rank.rank} of {rank.parameters}", "parameters"),
    ]  # fmt: skip
    return text, tiles


def _best(r: Results) -> str:
    """The reading of the noise whose residual comes nearest to the printed one."""
    return min(r.many, key=lambda n: abs(_of(r.many[n], "residual").mean - FINAL_UM[0]))


def _matched(r: Results) -> Pooled:
    return _of(r.many[_best(r)], "residual")


def _rest(r: Results) -> str:
    wide = float(np.hypot(*FINAL_UM)) ** 2 - _matched(r).mean ** 2 - _matched(r).sd ** 2
    return (
        f"is larger by {number(wide**0.5, 2)} µm in quadrature: the printed tests contain "
        "something more than this noise, for example functions that cannot follow the machine, "
        "or fewer parameters."
        if wide > 0.0
        else "is not larger than this."
    )


def _noisy(r: Results) -> str:
    return "; ".join(f"{n}: {_verdicts(r.rungs[n])}" for n in list(r.rungs)[:_NOISES])


def _verdicts(one: Rung) -> str:
    return _counted([v for c in one.both for v in c.verdicts])


def _apart(one: Rung) -> float:
    """How far the lengths of normal vectors are from those of the Monte Carlo."""
    return max(abs(found.mean[0] / found.mean[1] - 1.0) for found in one.lengths)


def _seen(r: Results, least: Callable[[Iterable[float]], float]) -> str:
    return number(least(_of(t, "residual").mean for t in r.influences.values()))


def _counted(verdicts: Sequence[str]) -> str:
    kinds = ("passed", "undecided", "failed")
    return ", ".join(f"{verdicts.count(k)} {k}" for k in kinds if k in verdicts)


def _freed(r: Results) -> str:
    """What happens to error motions where the fit's own sizes are made large."""
    name, one = list(r.rungs.items())[-1]
    ratio = _ratio(one.motions)
    worst = int(np.argmax(np.abs(np.log(ratio))))
    label = one.motions.labels[worst]
    m = {m.name: m for m in r.rank.motions}[label.split(" ")[0]]
    known = "known together with others only" if m.share < 0.9 else "seen at these points"
    return (
        f"with {name} the uncertainty of an error motion by the Monte Carlo is up to "
        f"{ratio[worst]:.2f} times that of the GUM ({label}, "
        f"{known if m.most else 'not seen at these points'}). Only second-order terms and the "
        "sizes that the fit assumes then determine how errors that act alike share what was "
        "measured, and a linear theory has no second-order terms. The errors at the points are "
        f"not affected: their ratio is {_range(one.components)}."
    )


def _range(c: Comparison) -> str:
    return f"{_ratio(c).min():.3f} to {_ratio(c).max():.3f}"


def _ratio(c: Comparison) -> np.ndarray:
    """Standard uncertainty of the Monte Carlo over that of the GUM."""
    return c.u[:, 1] / c.u[:, 0]


def _outputs(what: str, c: Comparison) -> Table:
    return table(
        "output | u, GUM | u, Monte Carlo | 95 %, GUM | 95 %, Monte Carlo | δ | clause 8",
        [(label, *c.u[i],
          *(f"[{number(c.low[i, k])}, {number(c.high[i, k])}]" for k in (0, 1)),
          number(c.delta[i], 2), c.verdicts[i]) for i, label in enumerate(c.labels)],
        fold=f"Every {what}, printed noise",
    )  # fmt: skip


def _node(r: Results, mm: float) -> int:
    """Row or column of the grid at a place along its side."""
    return round(mm / AREA_MM * (r.probing.u.shape[0] - 1))


def _rank(r: Results) -> Figure:
    rank, place = r.rank, np.arange(1, r.rank.parameters + 1)
    seen, unseen = place[: rank.rank], place[rank.rank :]
    floor = rank.singular[: rank.rank].min() / 30.0
    return panels(
        [Panel("Rank at Z = 0", "direction", "machine's spread over noise",
               [mark("semilogy", seen, rank.singular[: rank.rank], "o", color=AFTER, ms=5,
                     label="seen"),
                mark("semilogy", unseen, np.full(len(unseen), floor), "v", color=BEFORE, ms=5,
                     label="unseen (zero)"),
                mark("axhline", 1.0, color=NOMINAL, lw=1.0, ls="--")], "inside")],
        width=9.0, height=3.2,
    )  # fmt: skip


def _influences(r: Results) -> Figure:
    means = {
        label: {name: _of(t, kind).mean for name, t in r.influences.items()}
        for label, kind in (("as it is", "left"), ("after rigid alignment", "aligned"))
    }
    return panels(
        [Panel("Mean error left at the points", "µm", "",
               bars(means, horizontal=True, colours=(BEFORE, AFTER)), "right")],
        width=9.0, height=1.2 + 0.55 * len(r.influences),
    )  # fmt: skip


def _probing(r: Results) -> Figure:
    U = 2.0 * r.probing.u
    half = AREA_MM / (U.shape[0] - 1) / 2.0
    area: dict[str, Any] = {"extent": 2 * (-half, AREA_MM + half), "origin": "lower", "cmap": FIELD}
    return panels(
        [Panel(f"U of {axis} (k = 2)", "X, mm", "Y, mm",
               [mark("imshow", U[:, :, i].T, vmin=U.min(), vmax=U.max(), **area),
                mark("grid", False)]) for i, axis in enumerate("XYZ")],
        width=9.6, height=3.3, colours="µm",
    )  # fmt: skip


def _four(*values: float) -> Iterable[str]:
    return (number(value, 4) for value in values)


def _histograms(
    title: str, kind: str, series: Mapping[str, Trials], printed: float | None
) -> Figure:
    """One kind of error over all points and tests, X, Y, Z and distance; the first of the series is
    filled, `printed` marks a mean distance.
    """
    styles = (
        {"fill": True, "color": DOTS, "alpha": 0.6},
        *({"color": colour, "lw": 1.4} for colour in (AFTER, BEFORE, MARK)),
    )
    found = []
    for part in PARTS:
        pooled = {label: t.pooled[kind, part] for label, t in series.items()}
        marks = [
            mark("stairs", p.share / np.diff(p.edges), p.edges, label=label, **style)
            for (label, p), style in zip(pooled.items(), styles, strict=False)
        ]
        last = part == PARTS[-1]
        if last and printed is not None:
            line = mark("axvline", printed, color=INK, lw=1.0, ls="--", label="printed mean")
            marks.append(line)
        limits = {"ylim": (0.0, None), **({"xlim": (0.0, None)} if last else {})}
        found.append(Panel(f"{title}, {part}", "error, µm", "density per µm", marks,
                           "inside" if last else "", limits))  # fmt: skip
    return panels(found[:2], found[2:], width=9.0, height=6.0)


def _agreement(one: Rung) -> list[Mark]:
    """Ratio of the standard uncertainties, output by output, with the Monte Carlo's scatter."""
    ends = np.cumsum([0, *(len(c.labels) for c in one.both)])
    band = 2.0 / (2.0 * one.trials.ensemble.draws) ** 0.5
    return [
        *(mark("plot", np.arange(a, b), _ratio(c), ".", ms=4, color=colour, label=what)
          for a, b, c, colour, what in zip(ends, ends[1:], one.both, (AFTER, BEFORE),
                                           ("motions", "points"), strict=False)),
        mark("axhspan", 1.0 - band, 1.0 + band, color=DOTS, alpha=0.35, lw=0),
        mark("axhline", 1.0, color=INK, lw=0.8),
    ]  # fmt: skip


def _length(one: Rung, label: str) -> list[Mark]:
    """|d| at a point: Monte Carlo, and the length of a vector with the GUM's covariance."""
    values = one.trials.ensemble.values[:, one.trials.ensemble.index(label)]
    values = values[np.isfinite(values)]
    edges = np.linspace(0.0, 1.05 * values.max(), 50)
    k = 3 * [found.label for found in one.lengths].index(label)
    block = one.covariance[k : k + 3, k : k + 3]
    normal = np.random.default_rng(0).multivariate_normal(np.zeros(3), block, 200_000)
    density, _ = np.histogram(np.linalg.norm(normal, axis=1), edges, density=True)
    filled = {"density": True, "color": DOTS, "alpha": 0.6}
    return [
        mark("hist", values, edges, label="Monte Carlo", **filled),
        mark("stairs", density, edges, color=AFTER, lw=1.5, label="|normal vector|, GUM"),
    ]


TEXTS: dict[str, Callable[[Results], str]] = {
    "What the points can see": lambda r: f"""\
All points lie at Z = 0, and the tool point in the frame of Z. {r.rank.rank} combinations of the
{r.rank.parameters} parameters of the machine change the readings. The readings contain nothing
about {", ".join(m.name for m in r.rank.motions if m.silent == m.coefficients)}: their levers are
zero there. The error translations of Z enter as one constant each.
{sum(m.share > 0.5 for m in r.rank.motions)} of {len(r.rank.motions)} error motions and squareness
errors owe more than half of the information on every coefficient to the data; the rest are unseen,
or known in combinations that the points cannot separate, such as the slope of EXY with EC0Y.

The error at the points is known all the same: what is unseen there does not move them. It moves
every point off Z = 0, and any tool of another length.
:motions Least and most of the information on a coefficient that is not the family's: 1 − posterior
variance / prior variance.
:rank Singular values of the whitened Jacobian, in prior standard deviations of the machines per
standard deviation of the readings. Above the dashed line the data say more than the family did;
triangles are directions that change no reading.
""",
    "Printed and found": lambda r: """\
:numbers
""",
    "Initial error": lambda r: f"""\
The approximation functions of the publication are not printed. Machines are drawn instead: every
error motion is a Legendre polynomial with normal coefficients, one size for translations, one for
rotations and squareness. A search finds both, so that mean and standard deviation of |d| over all
points and machines are those printed: {number(r.search.family.translation_um, 4)} µm and
{number(r.search.family.rotation_urad, 4)} µrad per coefficient, with {r.search.machines} machines.

The ratio of the two moments depends on the ratio of the two sizes only, and can lie between
{r.search.spread_range[0]:.2f} and {r.search.spread_range[1]:.2f} here; the scale then meets the
mean. Both moments are therefore a setting and not a finding.
:initial_error Initial error of all points and tests (the publication's Fig. 5).
""",
    "Final error": lambda r: f"""\
The publication calls the distance between the measured points and those of the identified model the
residual error. It contains the noise of the readings almost whole. The error that is left in the
machine is another quantity, which no measurement shows: there the noise counts only as far as it
went into the identified parameters.

Whether the printed 24 µrad are one standard deviation or three is not said. The printed mean of
{FINAL_UM[0]} µm is nearest to {_best(r)} ({number(_matched(r).mean, 4)} µm); the spread there is
{number(_matched(r).sd)} µm against {FINAL_UM[1]} µm printed. The printed root mean square
{_rest(r)}

Components of the residual are normal; the distance cannot be. Mean plus two standard deviations is
therefore no interval of known coverage; the share of 95 % is in the table.
:final
:final_error Residual of the readings after identification (the publication's Fig. 6), for three
readings of the printed noise.
:error_left Error that is left, true less predicted tool point, on the same tests: smaller than the
residual, since the tracker's noise averages out over the points and is no error of the machine.
""",
    "The GUM and the Monte Carlo": lambda r: f"""\
The publication holds that the GUM cannot be used. Here is the linearised GUM through the
identification (implicit function theorem) beside the Monte Carlo of the same truth, noise and fit;
one significant digit of u is meaningful (JCGM 101, 7.9.2), and a verdict is undecided where the
Monte Carlo has too few draws to tell.

The model is linear where it matters: rotations of {number(r.search.family.rotation_urad)} µrad make
second-order terms of {number((1e-6 * r.search.family.rotation_urad) ** 2 * AREA_MM * 1e3, 2)} µm
over the area. With the noise alone raised, {_noisy(r)}. At a hundred times the noise the residual
has a mean of {number(_of(r.rungs[_LOUDEST].trials, 'residual').mean)} µm, and the data add little
to the family.

They differ in two places. First, the length |d|: its derivative at d = 0 does not exist, so that
the first-order GUM gives nothing ({len(r.rungs[_FIRST].undefined)} outputs). The components do not
share this, and the length of a normal vector with their covariance has the mean of the Monte Carlo
within {percent(_apart(r.rungs[_FIRST]))} at every point. Second, a fit that leaves unseen errors
free: {_freed(r)}
:rungs Largest |mean| / u: the GUM's value is zero throughout.
:lengths_table All in µm, printed noise.
:outputs_motions
:outputs_components
:gum_monte_carlo Standard uncertainty of the Monte Carlo over that of the GUM, for error motions at
three positions of their axis and components of the error at the points. Band: two standard
deviations of the Monte Carlo's own scatter about one.
:lengths Length of the error left at a corner and in the middle; the line is the length of a normal
vector with the covariance that the GUM gives for the components.
""",
    "What the publication leaves out": lambda r: f"""\
Reality holds more than the fit: positions that do not repeat ({_EVERY.repeatability_um:g} µm),
scales of X and Y that expand by {_EVERY.expansion_um_per_m_kelvin:g} µm/(m K) (standard deviations)
and warm up by {_EVERY.warming_kelvin:g} K during the measurement, with the machine judged at 20 °C,
and a tracker whose pose is uncertain by {_EVERY.pose_um:g} µm and {_EVERY.pose_urad:g} µrad, fitted
with that prior or not at all. All sizes are assumed.

The residual is mostly the tracker's noise: its mean lies between {_seen(r, min)} and
{_seen(r, max)} µm with every influence. A pose that is wrong moves all points as a rigid body; it
matters where a position against the tracker is asked for, not where the machine is compared with
itself (after alignment).
:influences_table Lengths |d| in µm; 24 µrad as three standard deviations.
:influences Mean error left with what the publication names and leaves out; assumed sizes.
""",
    "Probing with the verified machine": lambda r: f"""\
A point that the machine probes is uncertain by the error left there, by its repeatability
({r.probing.probe.repeatability_um:g} µm) and by the probe ({r.probing.probe.probe_um:g} µm per
direction; both standard deviations assumed).

Neighbouring points share most of the error that is left. In a length the shared part drops out;
where errors of the two ends have opposite signs it counts twice.
:points µm, k = 2.
:probed U in µm, k = 2.
:probing Expanded uncertainty of the coordinates of a probed point over the area.
""",
    "Settings": lambda r: f"""\
- Printed: chain XFYZ; 24 µrad and 4 µm + 0.8 µm/m; station {STATION_MM} mm with Euler angles XYZ
{EULER_XYZ_DEG}°, known; area of 400 mm × 400 mm at Z = 0.
- Not printed: {r.setting.grid} × {r.setting.grid} points; the reflector in the frame of Z, so that
the tool has no length; travel of 0 to 400 mm of every axis; Legendre degrees
{", ".join(map(str, r.setting.degrees))} in what is drawn and in what is fitted; the fit knows the
sizes of the family as its prior.
- The equation of motion as printed ends in the vector of Z where that of X has to stand; the chain
of vcal is exact in the rotations and has it so.
- Errors: initial = true less nominal tool point; residual = measured point less the model's; left =
true less predicted point.
~ JCGM 101:2008, clause 8; JCGM 102:2011; ISO 230-1:2012 names of errors.
""",
}  # fmt: skip

SHOWN: dict[str, Callable[[Results], Table | Figure]] = {
    "motions": lambda r: table(
        "error | coefficients | change no reading | information from data",
        [(m.name, m.coefficients, m.silent, percent(m.share) if m.coefficients == 1
          else f"{percent(m.share)} to {percent(m.most)}") for m in r.rank.motions],
        fold="Every error motion and squareness",
    ),
    "final": lambda r: table(
        "noise | error | mean |d|, µm | sd, µm | 95 % below, µm",
        [(name, kind, *_four(q.mean, q.sd, q.quantile(0.95))) for name, t in r.many.items()
         for kind in ("residual", "left") for q in [_of(t, kind)]],
    ),
    "rungs": lambda r: table(
        "setting | outputs | clause 8 | u, Monte Carlo / GUM | largest |mean| / u | failed",
        [(name, kind, _counted(c.verdicts), _range(c),
          f"{(np.abs(c.value[:, 1] - c.value[:, 0]) / c.u[:, 1]).max():.3f}", g.trials.failed)
         for name, g in r.rungs.items()
         for kind, c in zip(("error motions", "components at points"), g.both, strict=True)],
    ),
    "lengths_table": lambda r: table(
        "length | mean, GUM's components | mean, Monte Carlo | sd, GUM's components | "
        "sd, Monte Carlo | 95 % below",
        [(q.label.removesuffix(" [um]"), *_four(*q.mean, *q.sd, q.high)) 
         for q in r.rungs[_FIRST].lengths],
        fold="Length of the error left, point by point",
    ),
    "influences_table": lambda r: table(
        "there in reality | tests | residual, mean | left, mean | 95 % below | "
        "after alignment, mean",
        [(name, t.ensemble.draws, _of(t, "residual").mean, _of(t, "left").mean,
          _of(t, "left").quantile(0.95), _of(t, "aligned").mean)
         for name, t in r.influences.items()],
    ),
    "points": lambda r: table(
        "point, mm | U of X | U of Y | U of Z | u, machine, X | Y | Z",
        [(f"({x}, {y})", *(2.0 * r.probing.u[i, j]), *r.probing.u_machine[i, j])
         for x, y in ((0, 0), (400, 0), (200, 200), (400, 400))
         for i, j in [(_node(r, x), _node(r, y))]],
    ),
    "probed": lambda r: table(
        "length | mm | U | U, points taken as independent",
        [(q.name, number(q.length_mm, 4), 2.0 * q.u, 2.0 * q.u_independent)
         for q in r.probing.lengths],
    ),
    "outputs_motions": lambda r: _outputs("error motion", r.rungs[_FIRST].motions),
    "outputs_components": lambda r: _outputs("component at the points", r.rungs[_FIRST].components),
    "rank": _rank,
    "initial_error": lambda r: _histograms(
        "initial error", "initial",
        {f"{t.ensemble.draws} tests": t for t in (r.first, next(iter(r.few.values())))},
        INITIAL_UM[0],
    ),
    "final_error": lambda r: _histograms("residual", "residual", r.many, FINAL_UM[0]),
    "error_left": lambda r: _histograms("error left", "left", r.many, None),
    "gum_monte_carlo": lambda r: panels(
        *([Panel(name, "output", "u ratio", _agreement(g), "right" if name == _FIRST else "")]
          for name, g in r.rungs.items()),
        width=9.0, height=1.6 + 1.7 * len(r.rungs),
    ),
    "lengths": lambda r: panels(
        [Panel(label.removesuffix(" [um]"), "error left, µm", "density per µm",
               _length(one, label), "inside") for one in [r.rungs[_FIRST]] for label in
         [one.lengths[i].label for i in (0, len(one.lengths) // 2)]],
        width=9.0, height=3.3,
    ),
    "influences": _influences,
    "probing": _probing,
}  # fmt: skip

TRACKER_VERIFICATION = Reproduction(
    name="tracker-verification",
    summary="A laser tracker verifies a milling machine, and what that leaves: Aguado et al. 2017",
    title="Verification of a milling machine by a laser tracker",
    publication="Aguado et al. (2017), Monte Carlo method to machine tool uncertainty evaluation, "
    "MESIC, Vigo",
    compute=Results,
    rows=rows,
    record=record,
    head=_head,
    texts=TEXTS,
    shown=SHOWN,
    counted="tests",
    draws=CAMPAIGN,
    least=LEAST,
)
