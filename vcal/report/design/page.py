"""The page of a designed measurement."""

import math
from collections.abc import Sequence

import numpy as np

from ...design.optimiser import Designed, Seen, Task, Value, valuation
from ...geometry.declared_machine import DeclaredMachine
from ...study.study import Study
from ...words import counted
from ..html import text
from ..html.picture import Picture, Shown, by_section
from ..html.provenance import EXPANDED, NAMES, provenance_section
from ..html.sheet import Badge, Section, Table, Tile, sheet
from ..machine.section import machine_sections
from .pictures import uncertain
from .record import notes, sentence

_MOST_GROUPS = 40
_FOLDER = (
    "plan.csv beside this page holds the nominal axis positions, in the columns of a data file. "
    "The folder is a study of its own: vcal uncertainty can evaluate it, and the readings of the "
    "measurement can be added to it."
)
FILES = {"result.json": "all results, for programs", "plan.csv": "the plan"}
CONVENTIONS = (
    NAMES,
    "Expected rms volumetric error: root of the expected mean square, over a grid in the travel, "
    "of the length of the error of the tool point after compensation by the estimate of the "
    "declared family, after the best rigid alignment. The expectation is over the machines of the "
    "declared family and the noise; it is linear in the errors.",
    f"{EXPANDED} U of an error motion is the largest along its axis.",
    "Valuation: the share of the rms volumetric error before any measurement (by the priors alone) "
    "that the plan removes.",
    "Contribution of a pose or point: relative increase of the criterion without it, all others "
    "unchanged. All of this is known before the measurement; it depends on the declared family, "
    "noise and certificate.",
)


def page(
    done: Designed,
    seen: tuple[Seen, Seen],
    study: Study,
    drawn: Sequence[Picture],
    *,
    seed: int,
    machine: DeclaredMachine | None = None,
    command: str = "",
    seconds: float = math.nan,
) -> str:
    """The page as one self-contained HTML text, pictures included.

    The pictures of the declared `machine` are among `drawn`.
    """
    shown = by_section(drawn)
    better = done.best is not done.nominal
    return sheet(
        study.name,
        sentence(done),
        [
            _compared(done, seen),
            Section("Measuring positions", (_FOLDER,), pictures=shown.get("places", ())),
            *([_artefact(done, shown)] if "artefact" in shown else []),
            _errors(done, shown),
            _worth(done, shown),
            _starts(done),
            *machine_sections(machine, shown),
            Section("Frames, signs, units", points=CONVENTIONS),
            provenance_section(study, {"seed": f"{seed}"}, FILES, command, seconds),
        ],
        kicker="vcal – designed measurement",
        badge=Badge("Better plan", "good") if better else Badge("No better plan", "caution"),
        facts=_facts(done, study),
        warnings=notes(done),
        tiles=tiles(
            done.task,
            ("present plan", "designed plan"),
            (done.before, done.after),
            done.gain,
            done.prior,
        ),
    )


def _facts(done: Designed, study: Study) -> list[tuple[str, str]]:
    task, settings = done.task, study.single.design
    rows = counted(study.plan.rows, "row")
    chosen = [task.families[0].motions[i].name for i in task.families[0].chosen]
    found = [
        ("Machine", study.chain.text),
        study.observers,
        ("Goal", f"{settings.goal}: {task.criterion.words}"),
        ("Plan", f"{counted(len(task.space.groups), task.space.group)}, {rows}"),
        ("Variables", f"{len(task.space.low)} within bounds"),
    ]
    if task.criterion.name != "volume":
        found.append(("Errors that count", ", ".join(chosen)))
    if settings.families:
        found.append(("Averaged over", ", ".join((study.path.name, *settings.families))))
    return found


def tiles(
    task: Task,
    names: tuple[str, str],
    values: tuple[Value, Value],
    gain: float,
    prior: Value | None,
) -> list[Tile]:
    """Criterion and valuation before and after; `gain` is the share by which the former falls."""
    criterion = task.criterion
    before, after = (f"{text.number(v.criterion)} {text.unit(criterion.unit)}" for v in values)
    shares = [text.percent(valuation(v, prior)) for v in values]
    removed = f"of the prior rms volumetric error is removed; {shares[0]} with the {names[0]}"
    return [
        Tile(names[0], before, criterion.words),
        Tile(names[1], after, f"{text.percent(gain)} less"),
        Tile("valuation", shares[1], removed),
    ]


def _compared(done: Designed, seen: tuple[Seen, Seen]) -> Section:
    criterion, space = done.task.criterion, done.task.space
    values, unit = (done.before, done.after), text.unit(criterion.unit)
    removed = (text.percent(valuation(v, done.prior)) for v in values)
    times = (text.duration(space.seconds(p)) for p in (done.nominal, done.best))
    aligned = (text.number(v.aligned_um) for v in values)
    rows = [
        (criterion.words, *(text.number(v.criterion) for v in values), unit),
        ("expected rms volumetric error, aligned", *aligned, "µm"),
        ("the same without rigid alignment", *(text.number(v.raw_um) for v in values), "µm"),
        ("valuation: share of the prior rms that is removed", *removed, ""),
        ("rank of all readings", *(f"{s.rank} of {s.columns}" for s in seen), ""),
        ("measuring time", *times, ""),
    ]
    if criterion.name == "volume":
        del rows[1]  # the criterion itself
    combined = [
        f" The {word} plan determines only combinations of {', '.join(one.unseen)}."
        for word, one in zip(("present", "designed"), seen, strict=True)
        if one.unseen
    ]
    note = "Rank and observability are those without any prior and with all poses unknown."
    return Section(
        "Present and designed plan",
        tables=(Table(("", "present", "designed", ""), rows, "lrrl"),),
        note="".join([note, *combined]),
    )


def _artefact(done: Designed, shown: Shown) -> Section:
    before, after = (done.task.space.artefact(p) for p in (done.nominal, done.best))
    assert before is not None and after is not None
    axes = ("x_mm", "y_mm", "z_mm")
    moved = any(np.abs(before[c] - after[c]).max() > 1e-6 for c in axes)
    cells = [
        [f"{int(before['ball'][i])}", *(f"{t[c][i]:.2f}" for t in (before, after) for c in axes)]
        for i in range(len(before["ball"]))
    ]
    header = ("ball", "x", "y", "z", "x designed", "y", "z, mm")
    return Section(
        "Artefact",
        ("The design moves its balls." if moved else "The design leaves it unchanged.",),
        tables=(Table(header, cells, "lrrrrrr", fold="All balls, mm, present and designed"),),
        pictures=shown["artefact"],
    )


def _errors(done: Designed, shown: Shown) -> Section:
    rows = [
        (u.name, *map(text.number, (u.prior, u.before, u.after)), text.unit(u.unit))
        for u in uncertain(done.task, done.prior, done.before, done.after)
    ]
    header = ("error", "U before any measurement", "U, present plan", "U, designed plan", "unit")
    table = Table(header, rows, "lrrrl", fold="Every error at its largest uncertainty, k = 2")
    title = "Uncertainty of every error"
    return Section(title, tables=(table,), pictures=shown["uncertainties"])


def _worth(done: Designed, shown: Shown) -> Section:
    group, groups = done.task.space.group, done.task.space.groups
    order = np.argsort(-done.worse_after, kind="stable")[:_MOST_GROUPS]
    worse = (done.worse_after, done.worse_before)
    rows = [(str(groups[i]), *(text.percent(float(w[i])) for w in worse)) for i in order]
    header = (group, "increase of the criterion without it", "in the present plan")
    some = "" if len(rows) == len(done.worse_after) else f"; the {len(rows)} most important"
    table = Table(header, rows, "lrr", fold=f"Every {group}{some}")
    return Section(f"Contribution of every {group}", tables=(table,), pictures=shown["worth"])


def _starts(done: Designed) -> Section:
    rows = [
        (
            *(text.number(x, 4) for x in (f.start, f.value)),
            str(f.iterations),
            "yes" if f.converged else f"no: {f.message}",
            "yes" if fits else "no",
        )
        for f, fits in zip(done.found, done.fits, strict=True)
    ]
    header = ("criterion at the start", "at the end", "steps", "converged", "within the travel")
    about = (
        "Quasi-Newton search with exact gradients, best end first. Agreement of the ends indicates "
        "a global optimum."
    )
    smooth = ""
    if done.task.criterion.name == "largest":
        smooth = (
            "In place of the largest U, the search minimises the 24-norm of all U, which is smooth "
            "and slightly larger; the best end is selected by the largest U itself."
        )
    return Section(
        "Starts of the search", (about,), tables=(Table(header, rows, "rrrll"),), note=smooth
    )
