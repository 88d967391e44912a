"""The page: what was asked, what came out, and where it parts from the publication."""

from collections.abc import Mapping, Sequence

import numpy as np

from ...report import Picture, Section, Table, Tile, sheet
from ...report.html.text import DASH, number, percent, unit
from ...uncertainty.comparison import Comparison
from ..registry import Row
from .compared import Rung
from .rank import Seen
from .results import INFLUENCES, Results
from .setting import AREA_MM, EULER_XYZ_DEG, FINAL_UM, STATION_MM
from .trials import Trials

_MICROMETRE = "µm"
_NOISES = 3
"""Rungs that differ in the noise alone come first."""


def page(results: Results, rows: Sequence[Row], pictures: Mapping[str, tuple[Picture, ...]]) -> str:
    """The results as one self-contained HTML text."""
    many = next(iter(results.many.values()))
    residual, left = (many.pooled[kind, "distance"] for kind in ("residual", "left"))
    one = next(iter(results.rungs.values()))
    verdicts = [v for c in one.both for v in c.verdicts]
    summary = (
        f"The printed final error of {FINAL_UM[0]} µm is matched best by {_closest(results)}, "
        f"which gives {number(_mean(results, _closest(results)), 4)} µm; it is the residual of the "
        "readings, that is, mostly the tracker's own noise. Linearised GUM and Monte Carlo were "
        f"compared for {len(verdicts)} error motions and components: {_counted(verdicts)}. For the "
        f"{len(one.undefined)} lengths |d| the GUM has no first-order uncertainty."
    )
    tiles = [
        Tile("residual, mean |d|", f"{number(residual.mean, 4)} µm", f"printed {FINAL_UM[0]} µm"),
        Tile(
            "error really left, mean |d|", f"{number(left.mean)} µm", "known to a simulation only"
        ),
        Tile("GUM and Monte Carlo", _counted(verdicts), "JCGM 101, clause 8, one digit"),
        Tile("rank at Z = 0", f"{results.rank.rank} of {results.rank.parameters}", "parameters"),
    ]
    sections = [
        _rank(results, pictures["rank"]),
        _table(rows),
        _initial(results, pictures["initial"]),
        _final(results, pictures["final"]),
        _gum(results, pictures["gum"]),
        _influences(results, pictures["influences"]),
        _probing(results, pictures["probing"]),
        _settings(results),
    ]
    return sheet(
        "Verification of a milling machine by a laser tracker",
        summary,
        sections,
        kicker="vcal – a published campaign, done again",
        facts=[
            ("publication", "Aguado et al. (2017), Monte Carlo method to machine tool uncertainty "
             "evaluation, MESIC, Vigo"),
            ("tests", f"{results.draws}, every one with an identification; seed {results.seed}"),
        ],
        tiles=tiles,
    )  # fmt: skip


def _mean(results: Results, reading: str) -> float:
    return results.many[reading].pooled["residual", "distance"].mean


def _closest(results: Results) -> str:
    """The reading of the printed noise whose residual is nearest to the printed mean."""
    return min(results.many, key=lambda name: abs(_mean(results, name) - FINAL_UM[0]))


def _counted(verdicts: Sequence[str]) -> str:
    kinds = ("passed", "undecided", "failed")
    return ", ".join(f"{verdicts.count(k)} {k}" for k in kinds if k in verdicts)


# --- sections ---


def _rank(results: Results, pictures: tuple[Picture, ...]) -> Section:
    rank = results.rank
    silent = [m.name for m in rank.motions if m.silent == m.coefficients]
    seen = sum(m.share > 0.5 for m in rank.motions)
    return Section(
        "What the points can see",
        (
            f"All points lie at Z = 0, and the tool point in the frame of Z. Of the "
            f"{rank.parameters} parameters of the machine {rank.rank} combinations change the "
            f"readings. Nothing at all is seen of {', '.join(silent)}: their levers are zero "
            "there. The error translations of Z enter as one constant each. "
            f"{seen} of {len(rank.motions)} error motions and squareness errors owe more than half "
            "of the information on every coefficient to the data; the rest are unseen, or known in "
            "combinations that the points cannot part, such as the slope of EXY with EC0Y.",
            "The error at the points is known all the same: what is unseen there does not move "
            "them. It moves every point off Z = 0, and any tool of another length.",
        ),
        tables=(
            Table(
                ("error", "coefficients", "change no reading", "information from data"),
                [_seen(m) for m in rank.motions],
                "lrrr",
                note="Least and most of the information on a coefficient that is not the family's: "
                "1 − posterior variance / prior variance.",
                fold="Every error motion and squareness",
            ),
        ),
        pictures=pictures,
    )


def _seen(m: Seen) -> tuple[str, ...]:
    share = percent(m.share) if m.coefficients == 1 else f"{percent(m.share)} to {percent(m.most)}"
    return m.name, str(m.coefficients), str(m.silent), share


def _table(rows: Sequence[Row]) -> Section:
    lines = [
        (
            r.quantity,
            DASH if r.seed is None else f"{r.seed:.4g}",
            f"{r.vcal:.0f}" if r.unit == "1" else number(r.vcal, 4),
            unit(r.unit),
            r.note,
        )
        for r in rows
    ]
    return Section(
        "Printed and found",
        tables=(Table(("quantity", "printed", "vcal", "unit", "note"), lines, "lrrll"),),
    )


def _initial(results: Results, pictures: tuple[Picture, ...]) -> Section:
    search = results.search
    low, high = search.spread_range
    return Section(
        "Initial error",
        (
            "The approximation functions of the publication are not printed. Machines are drawn "
            "instead: every error motion is a Legendre polynomial with normal coefficients, one "
            "size for translations, one for rotations and squareness. Both are found by search, so "
            "that mean and standard deviation of |d| over all points and machines are those "
            f"printed: {number(search.family.translation_um, 4)} µm and "
            f"{number(search.family.rotation_urad, 4)} µrad per coefficient, "
            f"with {search.machines} machines.",
            "The ratio of the two moments depends on the ratio of the two sizes only, and can lie "
            f"between {low:.2f} and {high:.2f} here; the scale then meets the mean. Both moments "
            "are met by what is drawn, so that they are a setting and not a finding.",
        ),
        pictures=pictures,
    )


def _final(results: Results, pictures: tuple[Picture, ...]) -> Section:
    lines = []
    for name, t in results.many.items():
        for kind in ("residual", "left"):
            p = t.pooled[kind, "distance"]
            lines.append((name, kind, number(p.mean, 4), number(p.sd, 4),
                          number(p.quantile(0.95), 4)))  # fmt: skip
    best = _closest(results)
    p = results.many[best].pooled["residual", "distance"]
    wide = float(np.hypot(*FINAL_UM)) ** 2 - p.mean**2 - p.sd**2
    rest = (
        f"The printed root mean square is larger by {number(wide**0.5, 2)} µm in quadrature: the "
        "printed tests hold something more than this noise, for example functions that cannot "
        "follow the machine, or fewer parameters."
        if wide > 0.0
        else "The printed root mean square is not larger than this."
    )
    return Section(
        "Final error",
        (
            "What the publication calls the residual error is the distance between the measured "
            "points and those of the identified model. It holds the noise of the readings almost "
            "whole. The error that is left in the machine is another quantity, which no "
            "measurement shows: there the noise counts only as far as it went into the identified "
            "parameters.",
            f"Whether the printed 24 µrad are one standard deviation or three is not said. The "
            f"printed mean of {FINAL_UM[0]} µm is nearest to {best} ({number(p.mean, 4)} µm); the "
            f"spread there is {number(p.sd, 3)} µm against {FINAL_UM[1]} µm printed. {rest}",
            "Components of the residual are normal; the distance cannot be. Mean plus two standard "
            "deviations is therefore no interval of known coverage; the share of 95 % is in the "
            "table.",
        ),
        tables=(
            Table(("noise", "error", "mean |d|, µm", "sd, µm", "95 % below, µm"), lines, "llrrr"),
        ),
        pictures=pictures,
    )


def _gum(results: Results, pictures: tuple[Picture, ...]) -> Section:
    one = next(iter(results.rungs.values()))
    lines = [
        (name, kind, _counted(c.verdicts), _range(c),
         f"{_shift(c):.3f}", str(r.trials.failed))
        for name, r in results.rungs.items()
        for kind, c in zip(("error motions", "components at points"), r.both, strict=True)
    ]  # fmt: skip
    turn = results.search.family.rotation_urad
    bend = (turn * 1e-6) ** 2 * AREA_MM * 1e3
    noisy = "; ".join(
        f"{name}: {_counted([v for c in r.both for v in c.verdicts])}"
        for name, r in list(results.rungs.items())[:_NOISES]
    )
    loud = list(results.rungs.values())[_NOISES - 1]
    apart = max(abs(found.mean[0] / found.mean[1] - 1.0) for found in one.lengths)
    return Section(
        "The GUM and the Monte Carlo",
        (
            "The publication holds that the GUM cannot be used. Here is the linearised GUM through "
            "the identification (implicit function theorem) beside the Monte Carlo of the same "
            "truth, noise and fit; one significant digit of u is meaningful (JCGM 101, 7.9.2), and "
            "a verdict is undecided where the Monte Carlo is not settled enough to tell.",
            f"The model is linear where it matters: rotations of {number(turn, 3)} µrad make "
            f"second-order terms of {number(bend, 2)} µm over the area. With the noise alone "
            f"raised, {noisy}. At a hundred times the noise the residual has a mean of "
            f"{number(_residual(loud), 3)} µm, and the data say little more than the family.",
            f"They part in two places. First, the length |d|: its derivative at d = 0 does not "
            f"exist, so that the first-order GUM says nothing ({len(one.undefined)} outputs). The "
            "components do not share this, and the length of a normal vector with their covariance "
            f"has the mean of the Monte Carlo within {percent(apart)} at every point. Second, a "
            f"fit that leaves unseen errors free: {_freed(results)}",
        ),
        tables=(
            Table(
                ("setting", "outputs", "clause 8", "u, Monte Carlo / GUM", "largest |mean| / u",
                 "failed"),
                lines,
                "lllrrr",
                note="Largest |mean| / u: the GUM's value is zero throughout.",
            ),
            _lengths(one),
            _outputs(one.motions, "Every error motion, printed noise"),
            _outputs(one.components, "Every component at the points, printed noise"),
        ),
        pictures=pictures,
    )  # fmt: skip


def _residual(one: Rung) -> float:
    return one.trials.pooled["residual", "distance"].mean


def _freed(results: Results) -> str:
    """What happens to error motions where the fit's own sizes are made large."""
    name, one = list(results.rungs.items())[-1]
    ratio = _ratio(one.motions)
    worst = int(np.argmax(np.abs(np.log(ratio))))
    label = one.motions.labels[worst]
    known = {m.name: _known(m) for m in results.rank.motions}[label.split(" ")[0]]
    return (
        f"with {name} the uncertainty of an error motion by the Monte Carlo is up to "
        f"{ratio[worst]:.2f} times that of the GUM ({label}, {known}). Only second-order terms and "
        "the sizes that the fit believes in then say how errors that act alike share what was "
        "measured, and a linear theory has no second-order terms. The errors at the points are "
        f"not touched: their ratio is {_range(one.components)}."
    )


def _known(m: Seen) -> str:
    if m.most == 0.0:
        return "not seen at these points"
    return "known together with others only" if m.share < 0.9 else "seen at these points"


def _range(c: Comparison) -> str:
    return f"{_ratio(c).min():.3f} to {_ratio(c).max():.3f}"


def _ratio(c: Comparison) -> np.ndarray:
    return c.u[:, 1] / c.u[:, 0]


def _shift(c: Comparison) -> float:
    return float((np.abs(c.value[:, 1] - c.value[:, 0]) / c.u[:, 1]).max())


def _lengths(one: Rung) -> Table:
    rows = [
        (f.label.replace(" [um]", ""), *(number(v, 4) for v in (*f.mean, *f.sd, f.high)))
        for f in one.lengths
    ]
    return Table(
        ("length", "mean, GUM's components", "mean, Monte Carlo", "sd, GUM's components",
         "sd, Monte Carlo", "95 % below"),
        rows,
        "lrrrrr",
        note=f"All in {_MICROMETRE}, printed noise.",
        fold="Length of the error left, point by point",
    )  # fmt: skip


def _outputs(c: Comparison, fold: str) -> Table:
    rows = [
        (label, number(c.u[i, 0]), number(c.u[i, 1]),
         *(f"[{number(c.low[i, k])}, {number(c.high[i, k])}]" for k in (0, 1)),
         number(c.delta[i], 2), c.verdicts[i])
        for i, label in enumerate(c.labels)
    ]  # fmt: skip
    return Table(
        ("output", "u, GUM", "u, Monte Carlo", "95 %, GUM", "95 %, Monte Carlo", "δ", "clause 8"),
        rows,
        "lrrrrrl",
        fold=fold,
    )


def _influences(results: Results, pictures: tuple[Picture, ...]) -> Section:
    lines = [_influence(name, t) for name, t in results.influences.items()]
    everything = list(INFLUENCES.values())[-1]
    seen = [t.pooled["residual", "distance"].mean for t in results.influences.values()]
    return Section(
        "What the publication leaves out",
        (
            "Reality holds more than the fit: positions that do not repeat "
            f"({everything.repeatability_um:g} µm), scales of X and Y that expand by "
            f"{everything.expansion_um_per_m_kelvin:g} µm/(m K) (standard deviations) and warm up "
            f"by {everything.warming_kelvin:g} K during the measurement, with the machine judged "
            f"at 20 °C, and a tracker whose pose is uncertain by {everything.pose_um:g} µm and "
            f"{everything.pose_urad:g} µrad, fitted with that prior or not at all. All sizes are "
            "assumed.",
            "The residual is the tracker's noise for the most part: its mean lies between "
            f"{number(min(seen))} and {number(max(seen))} µm whatever is there. A pose that is "
            "wrong moves all points as a rigid body; it matters where a position against the "
            "tracker is asked for, not where the machine is compared with itself (after "
            "alignment).",
        ),
        tables=(
            Table(
                ("there in reality", "tests", "residual, mean", "left, mean", "95 % below",
                 "after alignment, mean"),
                lines,
                "lrrrrr",
                note=f"Lengths |d| in {_MICROMETRE}; 24 µrad as three standard deviations.",
            ),
        ),
        pictures=pictures,
    )  # fmt: skip


def _influence(name: str, t: Trials) -> tuple[str, ...]:
    residual, left, aligned = (t.pooled[k, "distance"] for k in ("residual", "left", "aligned"))
    values = (residual.mean, left.mean, left.quantile(0.95), aligned.mean)
    return name, str(t.ensemble.draws), *(number(v) for v in values)


def _probing(results: Results, pictures: tuple[Picture, ...]) -> Section:
    p = results.probing
    U = 2.0 * p.u
    side = U.shape[0]
    rows = [
        (name, *(number(float(v)) for v in U[i, j]), *(number(float(v)) for v in p.u_machine[i, j]))
        for name, i, j in (
            ("(0, 0)", 0, 0),
            ("(400, 0)", -1, 0),
            ("(200, 200)", side // 2, side // 2),
            ("(400, 400)", -1, -1),
        )
    ]
    lengths = [
        (one.name, number(one.length_mm, 4), number(2.0 * one.u), number(2.0 * one.u_independent))
        for one in p.lengths
    ]
    return Section(
        "Probing with the verified machine",
        (
            "A point that the machine probes is uncertain by the error left there, by its "
            f"repeatability ({p.probe.repeatability_um:g} µm) and by the probe "
            f"({p.probe.probe_um:g} µm per direction; both standard deviations assumed).",
            "Neighbouring points share most of the error that is left. In a length what they share "
            "drops out; where errors of the two ends have opposite signs it counts twice.",
        ),
        tables=(
            Table(
                ("point, mm", "U of X", "U of Y", "U of Z", "u, machine, X", "Y", "Z"),
                rows,
                "lrrrrrr",
                note=f"{_MICROMETRE}, k = 2.",
            ),
            Table(
                ("length", "mm", "U", "U, points taken as independent"),
                lengths,
                "lrrr",
                note=f"U in {_MICROMETRE}, k = 2.",
            ),
        ),
        pictures=pictures,
    )


def _settings(results: Results) -> Section:
    s = next(iter(results.many.values())).setting
    return Section(
        "Settings",
        points=(
            "Printed: chain XFYZ; 24 µrad and 4 µm + 0.8 µm/m; station "
            f"{STATION_MM} mm with Euler angles XYZ {EULER_XYZ_DEG}°, known; area of 400 mm × "
            "400 mm at Z = 0.",
            f"Not printed: {s.grid} × {s.grid} points; the reflector in the frame of Z, so that "
            "the tool has no length; travel of 0 to 400 mm of every axis; Legendre degrees "
            f"{', '.join(map(str, s.degrees))} in what is drawn and in what is fitted; the fit "
            "knows the sizes of the family as its prior.",
            "The equation of motion as printed ends in the vector of Z where that of X has to "
            "stand; the chain of vcal is exact in the rotations and has it so.",
            "Errors: initial = true less nominal tool point; residual = measured point less the "
            "model's; left = true less predicted point.",
        ),
        note="JCGM 101:2008, clause 8; JCGM 102:2011; ISO 230-1:2012 names of errors.",
    )
