"""The page of a virtual calibration: the uncertainty that a plan will achieve."""

import math
from collections.abc import Mapping, Sequence
from typing import Any

from ...study.study import Study
from ...uncertainty.comparison import Comparison
from ...uncertainty.virtual import STATISTICS, WHEN, VirtualCalibration
from ..html import text
from ..html.picture import Picture, by_section
from ..html.provenance import EXPANDED, NAMES, plain, provenance_section
from ..html.sheet import Badge, Section, Table, Tile, sheet
from .record import notes, sentence

_ORIGINS = {
    "noise": "noise of the instrument",
    "fitted": "identified: remainder of its prior",
    "not fitted": "present but not identified",
}
_NOTHING = 1e-9
"""Rounding, urad or um/m."""
_CONVENTIONS = (
    NAMES,
    "Volumetric error: length of the three-dimensional error of the tool point, after the best "
    "rigid alignment over all points, because an unknown station or pose leaves six rigid degrees "
    "of freedom unobservable. rms: root mean square over the points of one machine.",
    "Points are evaluated under the conditions (temperatures, times) of random rows of the plan, "
    "and with random directions of travel.",
    f"{EXPANDED} Intervals are probabilistically symmetric.",
    "Distributions are propagated through a simulated measurement and its evaluation, machine by "
    "machine, not through a measurement function of estimates as in JCGM 101. The spread of "
    "(identified − true) is what the procedure achieves on machines like those declared; it is not "
    "the uncertainty of one measurement that has been made.",
)


def page(
    result: VirtualCalibration,
    study: Study,
    drawn: Sequence[Picture],
    *,
    settings: Mapping[str, Any],
    command: str = "",
    seconds: float = math.nan,
) -> str:
    """The page as one self-contained HTML text, pictures included."""
    shown = by_section(drawn)
    sections = [
        _volumetric(result, shown),
        _sources(result, shown),
        _parameters(result),
        _motions(result, shown),
        *_lines(result),
        _unseen(result),
        _draws(result),
        Section("Frames, signs, units", points=_CONVENTIONS),
        provenance_section(
            study,
            {"settings": ", ".join(f"{k} = {v}" for k, v in plain(settings).items())},
            {"result.json": "all results, for programs"},
            command,
            seconds,
        ),
    ]
    return sheet(
        study.name,
        sentence(result),
        sections,
        kicker="vcal – uncertainty that a plan will achieve",
        badge=_badge(result),
        facts=_facts(result, study, settings),
        warnings=notes(result),
        tiles=_tiles(result),
    )


def _badge(result: VirtualCalibration) -> Badge:
    if result.ensemble.interrupted:
        return Badge("Interrupted", "caution")
    if result.faultless:
        return Badge("No error to improve")
    if result.improved > 0.99:
        return Badge("Improves the machine", "good")
    if result.improved > 0.5:
        return Badge("Improves most machines", "caution")
    return Badge("Does not improve the machine", "bad")


def _facts(
    result: VirtualCalibration, study: Study, settings: Mapping[str, Any]
) -> list[tuple[str, str]]:
    return [
        ("Machine", study.chain.text),
        study.observers,
        ("Plan", study.observations),
        ("Identified", f"{len(result.entries)} parameters"),
        ("Present but not identified", ", ".join(settings["with"]) or "nothing else"),
        ("Machines drawn", _count(result.ensemble.draws)),
    ]


def _tiles(result: VirtualCalibration) -> list[Tile]:
    share = text.percent(result.coverage)
    tiles = []
    for when in WHEN:
        found = result.volumetric("rms", when)
        span = f"{share} of the machines: {text.number(found.low)} to {text.number(found.high)} µm"
        tiles.append(Tile(f"rms volumetric error {when}", f"{text.number(found.mean)} µm", span))
    verdicts = result.parameters.verdicts
    tiles.append(
        Tile(
            "GUM confirmed (JCGM 101, clause 8)",
            f"{verdicts.count('passed')} of {len(verdicts)}",
            f"parameters; {verdicts.count('failed')} failed, {verdicts.count('undecided')} "
            "undecided",
        )
    )
    return tiles


def _volumetric(result: VirtualCalibration, shown: Mapping[str, tuple[Picture, ...]]) -> Section:
    rows = []
    for statistic in STATISTICS:
        for when in WHEN:
            v = result.volumetric(statistic, when)
            rows.append((f"{statistic}, {when}", *(text.number(x) for x in v), "µm"))
    share = text.percent(result.coverage)
    header = (
        "statistic over the points of a machine",
        "mean",
        "standard deviation",
        f"{share} from",
        "to",
        "",
    )
    smaller = f"The error decreased on {text.percent(result.improved)} of the machines."
    if result.faultless:
        smaller = "No machine drawn has an error."
    return Section(
        "Volumetric error before and after",
        (f"{smaller} Evaluated at {result.points.rows} points over the travel.",),
        tables=(Table(header, rows, "lrrrrl"),),
        pictures=(*shown.get("volumetric", ()), *shown.get("field", ())),
    )


def _sources(result: VirtualCalibration, shown: Mapping[str, tuple[Picture, ...]]) -> Section:
    rows = [
        (c.source, _ORIGINS[c.origin], text.number(c.rms), text.percent(c.share))
        for c in result.contributions
    ]
    if result.known > 0.0:
        total = result.rms_gum**2
        share = text.percent(result.known**2 / total)
        rows.append(("known values", _ORIGINS["not fitted"], text.number(result.known), share))
    rows.append(("total", "", text.number(result.rms_gum), ""))
    return Section(
        "Sources of uncertainty",
        (
            "Share of every source in the mean square of the volumetric error after calibration, "
            "by the GUM, with sensitivities of the identification from the implicit function "
            f"theorem. By Monte Carlo the rms is {text.number(result.rms_monte_carlo)} µm.",
        ),
        tables=(
            Table(
                ("source", "kind", "rms, µm", "share"),
                rows,
                "llrr",
                strong=frozenset([len(rows) - 1]),
            ),
        ),
        pictures=shown.get("sources", ()),
    )


def _parameters(result: VirtualCalibration) -> Section:
    c = result.parameters
    places = {label: i for i, label in enumerate(c.labels)}
    open_, folded = [], []
    for key, p in result.entries:
        row = _compared(c, places[f"{key}: {p.name} [{p.unit}]"], f"{key}: {p.name}", p.unit)
        # Error motions are reported along the axis; their coefficients are folded.
        coefficient = key == "geometric" and "." in p.name
        (folded if coefficient else open_).append(row)
    share = text.percent(result.coverage)
    header = (
        "parameter", "u, GUM", "u, Monte Carlo", f"{share}, GUM", f"{share}, Monte Carlo", "δ",
        "unit", "clause 8",
    )  # fmt: skip
    fold = f"{len(folded)} coefficients of error motions"
    tables = [Table(header, open_, "lrrrrrll")] if open_ else []
    tables += [Table(header, folded, "lrrrrrll", fold=fold)] if folded else []
    return Section(
        "Parameters: GUM and Monte Carlo",
        ("Identified minus true value over the machines drawn.",),
        tables=tuple(tables),
        note="Clause 8 of JCGM 101: passed where both ends of the GUM interval lie within δ of "
        f"those by Monte Carlo; δ is half a unit of the {_digit(c)} significant digit of u.",
    )


def _motions(result: VirtualCalibration, shown: Mapping[str, tuple[Picture, ...]]) -> Section:
    rows = []
    for m in result.motions:
        if not (m.prior.any() or m.u.any()):
            continue
        k = int(m.u.argmax())
        cells = (2 * m.prior[k], 2 * m.u_gum[k], 2 * m.u[k], m.low[k], m.high[k])
        rows.append((m.name, m.axis, *map(text.number, cells), text.unit(m.unit)))
    share = text.percent(result.coverage)
    header = (
        "error", "axis", "U before", "U, GUM", "U, Monte Carlo", f"{share} from", "to", "",
    )  # fmt: skip
    verdicts = result.motion_comparison.verdicts
    return Section(
        "Error motions along the axes",
        (
            f"Clause 8 over all {len(verdicts)} positions: {verdicts.count('passed')} passed, "
            f"{verdicts.count('failed')} failed, {verdicts.count('undecided')} undecided.",
        ),
        tables=(
            Table(
                header,
                rows,
                "llrrrrrl",
                fold="Every error motion at its largest uncertainty, U for k = 2",
            ),
        ),
        pictures=shown.get("motions", ()),
    )


def _lines(result: VirtualCalibration) -> list[Section]:
    """Squareness and scale; no section where none is declared."""
    c, rows = result.lines, []
    for i, label in enumerate(c.labels):
        name, unit = label.rstrip("]").split(" [")
        if max(result.lines_before[i], *c.u[i]) > _NOTHING:
            cells = (2 * result.lines_before[i], *(2 * c.u[i]), c.low[i, 1], c.high[i, 1])
            rows.append((name, *map(text.number, cells), text.unit(unit), c.verdicts[i]))
    if not rows:
        return []
    share = text.percent(result.coverage)
    header = (
        "error", "U before", "U, GUM", "U, Monte Carlo", f"{share} from", "to", "", "clause 8",
    )  # fmt: skip
    return [
        Section(
            "Squareness and scale of the axes",
            (
                "Least-squares lines through the tool point's paths, one axis after the other over "
                "its travel, the others at mid-travel (ISO 230-1): residual error of the angle "
                "between two of them and of the slope of positioning. The values depend neither "
                "on the frame nor on how slopes are divided between parameters.",
            ),
            tables=(Table(header, rows, "lrrrrrll"),),
        )
    ]


def _unseen(result: VirtualCalibration) -> Section:
    title = "Not observable with this plan"
    if not result.directions:
        return Section(title, ("No parameter has a prior to compare with.",))
    determined = (
        f"Of {result.directions} independent directions in the parameters with a prior, the plan "
        f"determines {result.determined} to better than half their prior variance."
    )
    if not result.unseen:
        return Section(title, (determined, "Every direction is at least partly observable."))
    fold = f"{len(result.hardly)} parameters that are poorly determined (less than 5 %)"
    table = Table(("",), [(name,) for name in result.hardly], fold=fold)
    return Section(
        title,
        (
            determined,
            "Combinations of parameters, in units of their priors, of which less than 1 % of the "
            "information comes from the measurement:",
        ),
        points=result.unseen,
        tables=(table,) if result.hardly else (),
        note="Many of them have no effect: a combination without influence on any point of the "
        "plan need not move the tool point anywhere else. The volumetric error above includes "
        "those that do.",
    )


def _draws(result: VirtualCalibration) -> Section:
    ensemble, campaign = result.ensemble, result.campaign
    rows = [
        ("machines drawn, measured and identified", _count(ensemble.draws)),
        ("solved by damped least squares instead of the shared curvature",
         text.percent(campaign.retried)),
        ("failed, and excluded from every statistic", _count(campaign.failed)),
        ("exact gradients per identification", text.number(campaign.gradients)),
        ("quantiles", "exact" if ensemble.kept == "exact" else "from counts in fine bins"),
    ]  # fmt: skip
    if ensemble.adaptive is not None:
        done = "all results stable" if ensemble.adaptive.settled else "not all results stable"
        rows.append(("adaptive (JCGM 101, 7.9.4)", done))
    return Section("Draws", tables=(Table(("", ""), rows, "lr"),))


def _compared(c: Comparison, i: int, name: str, unit: str) -> tuple[str, ...]:
    def interval(way: int) -> str:
        return f"{text.number(c.low[i, way])} … {text.number(c.high[i, way])}"

    return (
        name,
        text.number(c.u[i, 0]),
        text.number(c.u[i, 1]),
        interval(0),
        interval(1),
        text.number(c.delta[i], 1),
        text.unit(unit),
        c.verdicts[i],
    )


def _digit(c: Comparison) -> str:
    return {1: "first", 2: "second"}[c.digits]


def _count(n: int) -> str:
    return f"{n:,}".replace(",", " ")
