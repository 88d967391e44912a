"""The page of a virtual calibration: the uncertainty that a plan will achieve."""

import math
from collections.abc import Mapping, Sequence
from typing import Any

from ...geometry.declared_machine import DeclaredMachine
from ...study.study import Study
from ...uncertainty.comparison import Comparison
from ...uncertainty.virtual import STATISTICS, WHEN, VirtualCalibration
from ...words import counted, plural
from ..html import text
from ..html.picture import Picture, Shown, by_section
from ..html.provenance import EXPANDED, NAMES, plain, provenance_section
from ..html.sheet import Badge, Section, Table, Tile, sheet
from ..machine.section import machine_sections
from .record import VERDICTS, notes, sentence

FILES = {"result.json": "all results, for programs"}
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
    machine: DeclaredMachine | None = None,
    command: str = "",
    seconds: float = math.nan,
) -> str:
    """The page as one self-contained HTML text, pictures included.

    The pictures of the declared `machine` are among `drawn`.
    """
    shown = by_section(drawn)
    quoted = {"settings": ", ".join(f"{k} = {v}" for k, v in plain(settings).items())}
    sections = [
        _volumetric(result, shown),
        _sources(result, shown),
        _parameters(result),
        _motions(result, shown),
        *_lines(result),
        _unseen(result),
        _draws(result),
        *machine_sections(machine, shown),
        Section("Frames, signs, units", points=_CONVENTIONS),
        provenance_section(study, quoted, FILES, command, seconds),
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
        ("Identified", counted(len(result.entries), "parameter")),
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
    passed, *others = _verdicts(result.parameters)
    confirmed = f"{passed[0]} of {len(result.parameters.verdicts)}"
    note = "parameters; " + ", ".join(f"{n} {name}" for n, name in others)
    return [*tiles, Tile("GUM confirmed (JCGM 101, clause 8)", confirmed, note)]


def _verdicts(c: Comparison) -> list[tuple[int, str]]:
    """How many outputs have each verdict of clause 8."""
    return [(c.verdicts.count(name), name) for name in VERDICTS]


def _volumetric(result: VirtualCalibration, shown: Shown) -> Section:
    rows = [
        (f"{statistic}, {when}", *map(text.number, result.volumetric(statistic, when)), "µm")
        for statistic in STATISTICS
        for when in WHEN
    ]
    low = f"{text.percent(result.coverage)} from"
    header = ("over the points of a machine", "mean", "standard deviation", low, "to", "")
    smaller = f"The error decreased on {text.percent(result.improved)} of the machines."
    if result.faultless:
        smaller = "No machine drawn has an error."
    return Section(
        "Volumetric error before and after",
        (f"{smaller} Evaluated at {result.points.rows} points over the travel.",),
        tables=(Table(header, rows, "lrrrrl"),),
        pictures=(*shown.get("volumetric", ()), *shown.get("field", ())),
    )


def _sources(result: VirtualCalibration, shown: Shown) -> Section:
    rows = [
        (c.source, _ORIGINS[c.origin], text.number(c.rms), text.percent(c.share))
        for c in result.contributions
    ]
    if result.known > 0.0:
        share = text.percent(result.known**2 / result.rms_gum**2)
        rows.append(("known values", _ORIGINS["not fitted"], text.number(result.known), share))
    total, header = len(rows), ("source", "kind", "rms, µm", "share")
    rows.append(("total", "", text.number(result.rms_gum), ""))
    return Section(
        "Sources of uncertainty",
        (
            "Share of every source in the mean square of the volumetric error after calibration, "
            "by the GUM, with sensitivities of the identification from the implicit function "
            f"theorem. By Monte Carlo the rms is {text.number(result.rms_monte_carlo)} µm.",
        ),
        tables=(Table(header, rows, "llrr", strong=frozenset([total])),),
        pictures=shown.get("sources", ()),
    )


def _parameters(result: VirtualCalibration) -> Section:
    c = result.parameters
    places = {label: i for i, label in enumerate(c.labels)}
    open_, folded = [], []
    for key, p in result.entries:
        row = _compared(c, places[f"{key}: {p.name} [{p.unit}]"], f"{key}: {p.name}", p.unit)
        # Error motions are reported along the axis; their coefficients are folded.
        (folded if key == "geometric" and "." in p.name else open_).append(row)
    ways = ("GUM", "Monte Carlo")
    spans = (f"{text.percent(result.coverage)}, {way}" for way in ways)
    header = ("parameter", *(f"u, {way}" for way in ways), *spans, "δ", "unit", "clause 8")
    fold = f"{len(folded)} coefficients of error motions"
    digit = {1: "first", 2: "second"}[c.digits]
    return Section(
        "Parameters: GUM and Monte Carlo",
        ("Identified minus true value over the machines drawn.",),
        tables=(
            Table(header, open_, "lrrrrrll"),
            Table(header, folded, "lrrrrrll", fold=fold),
        ),
        note="Clause 8 of JCGM 101: passed where both ends of the GUM interval lie within δ of "
        f"those by Monte Carlo; δ is half a unit of the {digit} significant digit of u.",
    )


def _compared(c: Comparison, i: int, name: str, unit: str) -> tuple[str, ...]:
    spans = (f"{text.number(c.low[i, k])} … {text.number(c.high[i, k])}" for k in (0, 1))
    delta = text.number(c.delta[i], 1)
    return (name, *map(text.number, c.u[i]), *spans, delta, text.unit(unit), c.verdicts[i])


def _expanded(result: VirtualCalibration) -> tuple[str, ...]:
    """Header of expanded uncertainties before and after, and of the interval after."""
    return ("U before", "U, GUM", "U, Monte Carlo", f"{text.percent(result.coverage)} from", "to")


def _motions(result: VirtualCalibration, shown: Shown) -> Section:
    rows = []
    for m in result.motions:
        if m.prior.any() or m.u.any():
            k = int(m.u.argmax())
            cells = (2 * m.prior[k], 2 * m.u_gum[k], 2 * m.u[k], m.low[k], m.high[k])
            rows.append((m.name, m.axis, *map(text.number, cells), text.unit(m.unit)))
    header = ("error", "axis", *_expanded(result), "unit")
    fold = "Every error motion at its largest uncertainty, U for k = 2"
    c = result.motion_comparison
    counts = ", ".join(f"{n} {name}" for n, name in _verdicts(c))
    return Section(
        "Error motions along the axes",
        (f"Clause 8 over all {len(c.verdicts)} positions: {counts}.",),
        tables=(Table(header, rows, "llrrrrrl", fold=fold),),
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
    about = (
        "Least-squares lines through the tool point's paths, one axis after the other over its "
        "travel, the others at mid-travel (ISO 230-1): residual error of the angle between two of "
        "them and of the slope of positioning. The values depend neither on the frame nor on how "
        "slopes are divided between parameters."
    )
    table = Table(("error", *_expanded(result), "unit", "clause 8"), rows, "lrrrrrll")
    return [Section("Squareness and scale of the axes", (about,), tables=(table,))] * bool(rows)


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
    fold = (
        f"{counted(len(result.hardly), 'parameter')} that "
        f"{plural(len(result.hardly), 'is', 'are')} poorly determined (less than 5 %)"
    )
    table = Table(("",), [(name,) for name in result.hardly], fold=fold)
    return Section(
        title,
        (
            determined,
            "Combinations of parameters, in units of their priors, of which less than 1 % of the "
            "information comes from the measurement:",
        ),
        points=result.unseen,
        tables=(table,),
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


def _count(n: int) -> str:
    return f"{n:,}".replace(",", " ")
