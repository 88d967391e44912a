"""The page, the record and the pictures of the next measurement."""

import math
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from ...design.next_measurement import Candidate, NextMeasurement
from ...design.separation import ALPHA, Lambda, Separation
from ...instruments.conditions import file_name
from ...plots.designs import Places, Uncertain, angles_views, places_views, uncertainties
from ...plots.style import AFTER, BEFORE, png
from ...study.design.written_plan import plan_table
from ...study.study import Study
from ..html import text
from ..html.picture import Picture
from ..html.provenance import plain, provenance_section, versions
from ..html.sheet import Badge, Section, Table, Tile, sheet
from .page import CONVENTIONS, FILES
from .pictures import ANGLES, angles_of, in_space, of_lines, travel_of, view_of
from .record import DESIGN_SCHEMA, duration, share

_TESTS = (
    "Non-centrality λ of A against B: by how much χ² is expected to stay too large when A is real "
    "with the size given, and B is fitted in its place with the declared model, all priors "
    "included: a′ G a with the G of the test that the loop makes. Power: probability that the test "
    f"for A then fires at {100 * ALPHA:g} %, for one effect at one place; the loop, which looks "
    "everywhere, needs more.",
)


def next_sentence(done: NextMeasurement) -> str:
    """The answer in one sentence."""
    count = len(done.task.space.groups)
    several = count > 1
    what = f"{count} further {done.task.space.group}{'s' * several}"
    if done.separation is not None and done.separated is not None:
        first, second = (r.effect.key for r in done.separation.rivals)
        before, after = (_number(x.smaller) for x in (done.separated, _lambdas(done.best)))
        powers = [min(done.separation.powers(x)) for x in (done.separated, _lambdas(done.best))]
        verb = "raise" if several else "raises"
        return (
            f"{what} {verb} the expected lack of fit between {first} and {second} from {before} to "
            f"{after}; detection power at {100 * ALPHA:g} %: {text.percent(powers[0])} before, "
            f"{text.percent(powers[1])} after."
        )
    criterion = done.task.criterion
    words = f"{criterion.words} from {text.number(done.before.criterion)} to "
    after = f"{text.number(done.best.value.criterion)} {text.unit(criterion.unit)}"
    return f"{what} bring{'s' * (not several)} the {words}{after}."


def following_record(
    done: NextMeasurement,
    study: Study,
    *,
    seed: int,
    why: str,
    command: str = "",
    seconds: float = math.nan,
) -> dict[str, Any]:
    """Everything a program wants to know, as plain values."""
    task, best = done.task, done.best
    found: dict[str, Any] = {
        "schema": DESIGN_SCHEMA,
        "name": study.name,
        "next": True,
        "sentence": next_sentence(done),
        "why": why,
        "goal": task.criterion.name,
        "criterion": {"words": task.criterion.words, "unit": task.criterion.unit},
        "before": {"criterion": done.before.criterion, "rms_um": done.before.aligned_um},
        "after": {"criterion": best.value.criterion, "rms_um": best.value.aligned_um},
        "valuation": {
            "before": _valuation(done, done.before.aligned_um),
            "after": _valuation(done, best.value.aligned_um),
        },
        "measuring_seconds": task.space.seconds(best.placed),
        "group": task.space.group,
        "groups": task.space.groups,
        "separation": _separation(done),
        "candidates": [
            {
                "criterion": c.value.criterion,
                "lowers_by": _fall(done, c),
                "lambda": None if c.lambdas is None else c.lambdas.smaller,
                "at_mm": _centre(done, c),
            }
            for c in done.candidates
        ],
        "drawn": done.drawn,
        "searched_by_gradient": done.differentiable,
        "settings": {"seed": seed, "study": study.as_dict},
        "versions": versions(),
        "seconds": seconds,
        "input_files": dict(study.hashes),
        "command": command,
    }
    return plain(found)


def next_pictures(done: NextMeasurement) -> Iterator[Picture]:
    """All pictures, in the order of the page."""
    task = done.task
    present = done.present
    so_far = task._replace(space=present)
    if in_space(task):
        old = view_of(so_far, present.nominal, "measured so far", BEFORE)
        new = view_of(task, done.best.placed, "to be measured next", AFTER)
        caption = "Where the axes stood so far (left), and where they are to stand next (right)."
        views: Sequence[Places] = (old, new)
        yield Picture("places", "places", caption, png(places_views(travel_of(task), views)))
    turned = [
        angles_of(so_far, present.nominal, "measured so far", BEFORE),
        angles_of(task, done.best.placed, "to be measured next", AFTER),
    ]
    if turned[0].travel:
        yield Picture("angles", "angles", ANGLES, png(angles_views(turned)))
    motions = task.families[0].motions
    prior = np.full(len(motions), np.nan) if done.prior is None else done.prior.largest
    rows = [
        Uncertain(m.name, m.unit, float(p), float(b), float(a))
        for m, p, b, a in zip(
            motions, prior, done.before.largest, done.best.value.largest, strict=True
        )
    ]
    caption = (
        "Largest expanded uncertainty (k = 2) of every error along its axis: before any "
        "measurement (bar), by the data so far (orange), with the next measurement (blue)."
    ) + of_lines(task)
    drawn = uncertainties(rows, ("data so far", "with the next"))
    yield Picture("uncertainties", "uncertainties", caption, png(drawn))


def next_page(
    done: NextMeasurement,
    study: Study,
    drawn: Sequence[Picture],
    *,
    seed: int,
    why: str,
    command: str = "",
    seconds: float = math.nan,
) -> str:
    """The page as one self-contained HTML text, pictures included."""
    shown = {picture.section: picture for picture in drawn}
    settings = study.single.design
    return sheet(
        study.name,
        next_sentence(done),
        [
            *([_rivals(done.separation, done.separated, _lambdas(done.best))]
              if done.separation is not None and done.separated is not None else []),
            _candidates(done),
            Section(
                "Where to measure next",
                ("plan.csv beside this page holds the rows to be measured, and only those. "
                 + carried_over(done, study),),
                tables=(_conditions(done, study),) if done.separation is not None else (),
                pictures=tuple(shown[name] for name in ("places", "angles") if name in shown),
            ),
            Section("What is left of every error", pictures=(shown["uncertainties"],)),
            Section("Frames, signs, units", points=(*CONVENTIONS, *_TESTS)),
            provenance_section(study, {"seed": f"{seed}"}, FILES, command, seconds),
        ],
        kicker="vcal – what to measure next",
        badge=Badge("Next", "plain"),
        facts=[
            ("Machine", study.chain.text),
            study.observers,
            ("So far", f"{len(done.present.groups)} {done.present.group}s, {study.plan.rows} rows"),
            ("Next", f"{len(done.task.space.groups)} {done.task.space.group}s"),
            ("Goal", _goal(done, settings.goal)),
            ("Why", why),
            ("Measuring time", duration(done.task.space.seconds(done.best.placed))),
        ],
        tiles=_tiles(done),
    )  # fmt: skip


def _goal(done: NextMeasurement, goal: str) -> str:
    if done.separation is None:
        return f"{goal}: {done.task.criterion.words}"
    first, second = (r.effect.key for r in done.separation.rivals)
    return f"tell {first} from {second}"


def _tiles(done: NextMeasurement) -> list[Tile]:
    criterion, unit = done.task.criterion, text.unit(done.task.criterion.unit)
    told = [
        Tile("by the data so far", f"{text.number(done.before.criterion)} {unit}", criterion.words),
        Tile(
            "with the next",
            f"{text.number(done.best.value.criterion)} {unit}",
            f"{share(_fall(done, done.best))} less",
        ),
        Tile(
            "valuation",
            share(_valuation(done, done.best.value.aligned_um)),
            f"of the prior rms volumetric error is removed; "
            f"{share(_valuation(done, done.before.aligned_um))} by the data so far",
        ),
    ]
    return told


def _rivals(separation: Separation, before: Lambda, after: Lambda) -> Section:
    first, second = (r.effect.key for r in separation.rivals)
    powers = [separation.powers(x) for x in (before, after)]
    rows = []
    for i, (real, fitted) in enumerate(((first, second), (second, first))):
        rows.append(
            (
                real,
                fitted,
                "as given" if separation.rivals[i].sized else "of its prior",
                _number(before[i]),
                _number(after[i]),
                text.percent(powers[0][i]),
                text.percent(powers[1][i]),
            )
        )
    header = ("real", "fitted instead", "size", "λ so far", "λ then", "power so far", "power then")
    return Section(
        "Which of the two it is",
        tables=(Table(header, rows, "lllrrrr"),),
        note=_TESTS[0],
    )


def _candidates(done: NextMeasurement) -> Section:
    rows = []
    for number, c in enumerate(done.candidates, start=1):
        at = _centre(done, c)
        row = [str(number), text.number(c.value.criterion, 4), share(_fall(done, c))]
        if done.separation is not None:
            row.append(_number(_lambdas(c).smaller))
        rows.append((*row, ", ".join(f"{v:.0f}" for v in at) if at else ""))
    separate = ("smaller λ",) if done.separation is not None else ()
    where = "middle, X Y Z in mm"
    header = ("", "criterion then", "lower by", *separate, where)
    way = (
        f"{done.drawn} were tried at random; the best {len(rows)} of them were moved by gradient."
        if done.differentiable
        else f"An effect cannot be differentiated by positions: the best of {done.drawn} that were "
        "tried at random, none of them moved."
    )
    align = "rrr" + "r" * len(separate) + "r"
    return Section("Candidates, best first", (way,), tables=(Table(header, rows, align),))


def _conditions(done: NextMeasurement, study: Study) -> Table:
    """Of the columns of plan.csv those on which the rivals depend, positions aside."""
    columns = plan_table(study, done.task.space, done.best.placed)
    names = sorted(_wanted(done, study) & columns.keys())
    rows = [
        (name, *(text.number(float(end(columns[name])), 4) for end in (np.min, np.max)))
        for name in names
    ]
    note = "Columns of plan.csv, in the units of their names."
    return Table(("condition", "lowest", "highest"), rows, "lrr", note=note)


def _wanted(done: NextMeasurement, study: Study) -> set[str]:
    """Columns on which rivals that are to be told apart depend, positions aside."""
    if done.separation is None:
        return set()
    axes = study.chain.axes
    needs = {n for r in done.separation.rivals for n in r.effect.needs if n not in axes}
    return {file_name(n, axes) for n in needs}


def carried_over(done: NextMeasurement, study: Study) -> str:
    """Which columns of plan.csv nothing but the last row of the data tells, as a sentence."""
    axes, space = study.chain.axes, done.task.space
    instrument = space.instrument(done.best.placed)
    own = instrument.columns(study.one.settings, axes, readings=False)
    chosen = {file_name(axis, axes) for axis in axes} | {column.name for column in own}
    chosen |= study.plan.groups.keys() | _wanted(done, study)
    names = [n for n in plan_table(study, space, done.best.placed) if n not in chosen]
    if not names:
        return ""
    return (
        f"In plan.csv {', '.join(names)} are as in the last row of the data: replace them by what "
        "they are when the rows are measured, as effects are told by them."
    )


def _separation(done: NextMeasurement) -> Mapping[str, Any] | None:
    if done.separation is None or done.separated is None:
        return None
    found = {}
    for word, value in (("before", done.separated), ("after", _lambdas(done.best))):
        found[f"lambda_{word}"] = list(value)
        found[f"power_{word}"] = list(done.separation.powers(value))
    rivals = [r.effect.key for r in done.separation.rivals]
    sizes = [np.sqrt(np.diagonal(r.moment)) for r in done.separation.rivals]
    return {"effects": rivals, "sizes_in_prior_units": sizes, "alpha": ALPHA, **found}


def _lambdas(candidate: Candidate) -> Lambda:
    assert candidate.lambdas is not None
    return candidate.lambdas


def _number(value: float) -> str:
    return text.number(value if value > 1e-6 else 0.0)


def _fall(done: NextMeasurement, candidate: Candidate) -> float:
    return 1.0 - candidate.value.criterion / done.before.criterion


def _valuation(done: NextMeasurement, rms_um: float) -> float:
    return math.nan if done.prior is None else 1.0 - rms_um / done.prior.aligned_um


def _centre(done: NextMeasurement, candidate: Candidate) -> list[float] | None:
    plan = done.task.space.plan(candidate.placed)
    if not in_space(done.task):
        return None
    return [1e3 * float(np.asarray(plan.x(axis)).mean()) for axis in "XYZ"]
