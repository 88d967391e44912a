"""The page of a virtual calibration."""

import math
from collections.abc import Mapping, Sequence
from typing import Any

from ...study.study import Study
from ...uncertainty.comparison import Comparison
from ...uncertainty.virtual import STATISTICS, WHEN, VirtualCalibration
from ..html import text
from ..html.picture import Picture
from ..html.provenance import EXPANDED, NAMES, provenance
from ..html.sheet import Badge, Section, Table, Tile, sheet
from ..loop.record import plain
from .record import notes, sentence

_ORIGINS = {
    "noise": "noise of the instrument",
    "fitted": "fitted: what the data leave of its prior",
    "not fitted": "in reality, but not fitted",
}
_NOTHING = 1e-9
"""urad or um/m: rounding."""
_CONVENTIONS = (
    NAMES,
    "Volumetric error: length of the three-dimensional error of the tool point, after the best "
    "rigid alignment over all points, because an unknown station or pose leaves six rigid degrees "
    "of freedom invisible. rms: root mean square over the points of one machine.",
    "Points are judged under the conditions (temperatures, times) of rows of the plan picked at "
    "random, and from random directions of travel.",
    f"{EXPANDED} Intervals are probabilistically symmetric.",
    "Distributions are propagated through a simulated measurement and its evaluation, machine by "
    "machine, not through a measurement function of estimates as in JCGM 101. The spread of "
    "(identified − true) is what the procedure will achieve on machines like those declared; it "
    "is not the uncertainty of one measurement that has been made.",
)


def virtual_page(
    result: VirtualCalibration,
    study: Study,
    settings: Mapping[str, Any],
    drawn: Sequence[Picture],
    *,
    command: str = "",
    seconds: float = math.nan,
) -> str:
    """The page as one self-contained HTML text, pictures included."""
    shown = {picture.section: picture for picture in drawn}
    sections = [
        _volumetric(result, shown),
        _sources(result, shown),
        _parameters(result),
        _motions(result, shown),
        *_lines(result),
        _unseen(result),
        _draws(result),
        Section("Frames, signs, units", points=_CONVENTIONS),
        provenance(
            study,
            {"settings": ", ".join(f"{k} = {v}" for k, v in plain(settings).items())},
            command,
            seconds,
            "and the pictures",
        ),
    ]
    return sheet(
        study.name,
        sentence(result),
        sections,
        kicker="vcal – which uncertainty a plan will give",
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
        ("Fitted", f"{len(result.entries)} parameters"),
        ("In reality, not fitted", ", ".join(settings["with"]) or "nothing else"),
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


def _volumetric(result: VirtualCalibration, shown: Mapping[str, Picture]) -> Section:
    rows = []
    for statistic in STATISTICS:
        for when in WHEN:
            v = result.volumetric(statistic, when)
            rows.append((f"{statistic}, {when}", *(text.number(x) for x in v), "µm"))
    share = text.percent(result.coverage)
    header = (
        "over the points of a machine",
        "mean",
        "standard deviation",
        f"{share} from",
        "to",
        "",
    )
    pictures = tuple(shown[name] for name in ("volumetric", "field") if name in shown)
    smaller = f"The error got smaller on {text.percent(result.improved)} of the machines."
    if result.faultless:
        smaller = "No machine drawn has an error."
    return Section(
        "Volumetric error before and after",
        (f"{smaller} Judged at {result.points.rows} points over the travel.",),
        tables=(Table(header, rows, "lrrrrl"),),
        pictures=pictures,
    )


def _sources(result: VirtualCalibration, shown: Mapping[str, Picture]) -> Section:
    rows = [
        (c.source, _ORIGINS[c.origin], text.number(c.rms), text.percent(c.share))
        for c in result.contributions
    ]
    if result.known > 0.0:
        total = result.rms_gum**2
        share = text.percent(result.known**2 / total)
        rows.append(("known values", _ORIGINS["not fitted"], text.number(result.known), share))
    rows.append(("together", "", text.number(result.rms_gum), ""))
    return Section(
        "Where it comes from",
        (
            "Share of every source in the mean square of the volumetric error after calibration, "
            "by the GUM through the identification (implicit function theorem). By Monte Carlo the "
            f"root mean square is {text.number(result.rms_monte_carlo)} µm.",
        ),
        tables=(
            Table(
                ("source", "", "rms, µm", "share"),
                rows,
                "llrr",
                strong=frozenset([len(rows) - 1]),
            ),
        ),
        pictures=tuple(shown[name] for name in ("sources",) if name in shown),
    )


def _parameters(result: VirtualCalibration) -> Section:
    c = result.parameters
    places = {label: i for i, label in enumerate(c.labels)}
    open_, folded = [], []
    for key, p in result.entries:
        row = _compared(c, places[f"{key}: {p.name} [{p.unit}]"], f"{key}: {p.name}", p.unit)
        # An error motion is told by its course along the axis rather than by coefficients.
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
        ("Identified less true value over the machines drawn.",),
        tables=tuple(tables),
        note="Clause 8 of JCGM 101: passed where both ends of the GUM's interval lie within δ of "
        f"the Monte Carlo's; δ is half a unit of the {_digit(c)} significant digit of u.",
    )


def _motions(result: VirtualCalibration, shown: Mapping[str, Picture]) -> Section:
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
                fold="Every error motion where it is least certain, U for k = 2",
            ),
        ),
        pictures=tuple(shown[name] for name in ("motions",) if name in shown),
    )


def _lines(result: VirtualCalibration) -> list[Section]:
    """None where nothing of them is declared."""
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
                "its travel, the others in the middle of theirs (ISO 230-1): what is left of the "
                "angle between two of them and of the slope of positioning. These depend neither "
                "on the frame nor on how slopes are shared out between parameters.",
            ),
            tables=(Table(header, rows, "lrrrrrll"),),
        )
    ]


def _unseen(result: VirtualCalibration) -> Section:
    if not result.directions:
        return Section("What the plan cannot see", ("No parameter has a prior to compare with.",))
    told = (
        f"Of {result.directions} independent directions in the parameters that have a prior, the "
        f"plan determines {result.determined} to better than half their prior variance.",
    )
    if not result.unseen:
        return Section("What the plan cannot see", (*told, "It sees something of every one."))
    tables = ()
    if result.hardly:
        rows = [(name,) for name in result.hardly]
        fold = f"{len(rows)} parameters of which it says hardly anything (less than 5 %)"
        tables = (Table(("",), rows, fold=fold),)
    return Section(
        "What the plan cannot see",
        (
            *told,
            "Combinations of parameters, in units of their priors, of which less than 1 % of the "
            "information comes from the measurement:",
        ),
        points=result.unseen,
        tables=tables,
        note="Many of them do not matter: what no point of the plan feels need not move the tool "
        "point anywhere else either. The volumetric error above counts those that do.",
    )


def _draws(result: VirtualCalibration) -> Section:
    ensemble, campaign = result.ensemble, result.campaign
    rows = [
        ("machines drawn, measured and identified", _count(ensemble.draws)),
        ("solved by damped least squares instead of the shared curvature",
         text.percent(campaign.retried)),
        ("failed, and left out of every statistic", _count(campaign.failed)),
        ("exact gradients per identification", text.number(campaign.gradients)),
        ("quantiles", "exact" if ensemble.kept == "exact" else "from counts in fine bins"),
    ]  # fmt: skip
    if ensemble.adaptive is not None:
        done = "all results stable" if ensemble.adaptive.settled else "not all results stable"
        rows.append(("adaptive (JCGM 101, 7.9.4)", done))
    return Section("How the draws went", tables=(Table(("", ""), rows, "lr"),))


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
