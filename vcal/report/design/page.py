"""The page of a designed measurement."""

import math
from collections.abc import Mapping, Sequence

import numpy as np

from ...design.optimiser import Designed, Seen, valuation
from ...study.study import Study
from ..html import text
from ..html.picture import Picture
from ..html.provenance import EXPANDED, NAMES, provenance
from ..html.sheet import Badge, Section, Table, Tile, sheet
from .pictures import uncertain
from .record import design_notes, design_sentence, duration, share

_MOST_GROUPS = 40
CONVENTIONS = (
    NAMES,
    "Expected rms volumetric error: root of the expected mean square, over a grid in the travel, "
    "of the length of the error of the tool point after compensation by the declared family's own "
    "estimate; after the best rigid alignment, the raw figure beside it. It averages over machines "
    "of the declared family and over the noise; it is linear in the errors.",
    f"{EXPANDED} U of an error motion is the largest along its axis.",
    "Valuation: the share of the rms volumetric error before any measurement (by the priors alone) "
    "that the plan removes.",
    "Worth of a pose or point: by which share the criterion gets worse without it, all others as "
    "they are. All of this is known before anything is measured; it stands on the declared family, "
    "noise and certificate.",
)


def design_page(
    done: Designed,
    seen: tuple[Seen, Seen],
    study: Study,
    drawn: Sequence[Picture],
    *,
    seed: int,
    command: str = "",
    seconds: float = math.nan,
) -> str:
    """The page as one self-contained HTML text, pictures included."""
    shown = {picture.section: picture for picture in drawn}
    better = done.best is not done.nominal
    return sheet(
        study.name,
        design_sentence(done),
        [
            _compared(done, seen),
            _places(done, shown),
            *([_artefact(done, shown)] if "artefact" in shown else []),
            _errors(done, shown),
            _worth(done, shown),
            _starts(done),
            Section("Frames, signs, units", points=CONVENTIONS),
            provenance(study, {"seed": str(seed)}, command, seconds, "plan.csv and the pictures"),
        ],
        kicker="vcal – a measurement designed",
        badge=Badge("Better plan", "good") if better else Badge("No better plan", "caution"),
        facts=facts(done, study),
        warnings=design_notes(done),
        tiles=_tiles(done),
    )


def facts(done: Designed, study: Study) -> list[tuple[str, str]]:
    """What was asked."""
    task, settings = done.task, study.single.design
    chosen = [task.families[0].motions[i].name for i in task.families[0].chosen]
    told = [
        ("Machine", study.chain.text),
        study.observers,
        ("Goal", f"{settings.goal}: {task.criterion.words}"),
        ("Plan", f"{len(task.space.groups)} {task.space.group}s, {study.plan.rows} rows"),
        ("Free", f"{len(task.space.low)} numbers within bounds"),
    ]
    if task.criterion.name != "volume":
        told.append(("Errors that count", ", ".join(chosen)))
    if settings.families:
        told.append(("Averaged over", ", ".join((study.path.name, *settings.families))))
    return told


def _tiles(done: Designed) -> list[Tile]:
    criterion = done.task.criterion
    unit = text.unit(criterion.unit)
    return [
        Tile("as it is", f"{text.number(done.before.criterion)} {unit}", criterion.words),
        Tile("designed", f"{text.number(done.after.criterion)} {unit}", f"{share(done.gain)} less"),
        Tile(
            "valuation of the designed plan",
            share(valuation(done.after, done.prior)),
            "of the prior rms volumetric error is removed; "
            f"{share(valuation(done.before, done.prior))} as it is",
        ),
    ]


def _compared(done: Designed, seen: tuple[Seen, Seen]) -> Section:
    criterion, space = done.task.criterion, done.task.space
    values, unit = (done.before, done.after), text.unit(criterion.unit)
    rows = [(criterion.words, *(text.number(v.criterion) for v in values), unit)]
    if criterion.name != "volume":
        rows.append(
            (
                "expected rms volumetric error, aligned",
                *(text.number(v.aligned_um) for v in values),
                "µm",
            )
        )
    rows += [
        ("the same without rigid alignment", *(text.number(v.raw_um) for v in values), "µm"),
        (
            "valuation: share of the prior rms that is removed",
            *(share(valuation(v, done.prior)) for v in values),
            "",
        ),
        ("rank of all readings", *(f"{s.rank} of {s.columns}" for s in seen), ""),
        (
            "measuring time",
            *(duration(space.seconds(p)) for p in (done.nominal, done.best)),
            "",
        ),
    ]
    lines = [
        f"{word}, these are seen in combinations only: {', '.join(one.unseen)}."
        for word, one in zip(("As it is", "As designed"), seen, strict=True)
        if one.unseen
    ]
    note = "Rank, and what is seen, are told without any prior and with all poses unknown. "
    return Section(
        "As it is and as designed",
        tables=(Table(("", "as it is", "designed", ""), rows, "lrrl"),),
        note=" ".join([note, *lines]),
    )


def _places(done: Designed, shown: Mapping[str, Picture]) -> Section:
    return Section(
        "Where it is measured",
        (
            "plan.csv beside this page holds the nominal positions of the axes, in the columns of "
            "a data file. The folder is a study of its own: vcal uncertainty on it draws machines, "
            "and the measurement fills it.",
        ),
        pictures=tuple(shown[name] for name in ("places", "angles") if name in shown),
    )


def _artefact(done: Designed, shown: Mapping[str, Picture]) -> Section:
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
        ("Its balls move as well." if moved else "It stays as it is.",),
        tables=(
            Table(header, cells, "lrrrrrr", fold="All balls, mm, as they are and as designed"),
        ),
        pictures=(shown["artefact"],),
    )


def _errors(done: Designed, shown: Mapping[str, Picture]) -> Section:
    rows = [
        (u.name, *(text.number(v) for v in (u.prior, u.before, u.after)), text.unit(u.unit))
        for u in uncertain(done)
    ]
    header = ("error", "U before any measurement", "U as it is", "U designed", "")
    return Section(
        "What is left of every error",
        tables=(Table(header, rows, "lrrrl", fold="Every error where it is least certain, k = 2"),),
        pictures=(shown["uncertainties"],),
    )


def _worth(done: Designed, shown: Mapping[str, Picture]) -> Section:
    group = done.task.space.group
    order = np.argsort(-done.worse_after, kind="stable")[:_MOST_GROUPS]
    rows = [
        (
            str(done.task.space.groups[i]),
            text.percent(float(done.worse_after[i])),
            text.percent(float(done.worse_before[i])),
        )
        for i in order
    ]
    header = (group, "criterion worse without it", f"without that {group} of the plan as it is")
    some = "" if len(rows) == len(done.worse_after) else f"; the {len(rows)} that count most"
    return Section(
        f"What every {group} is worth",
        tables=(Table(header, rows, "lrr", fold=f"Every {group}{some}"),),
        pictures=(shown["worth"],),
    )


def _starts(done: Designed) -> Section:
    rows = [
        (
            text.number(f.start, 4),
            text.number(f.value, 4),
            str(f.iterations),
            "yes" if f.converged else f"no: {f.message}",
            "yes" if fits else "no",
        )
        for f, fits in zip(done.found, done.fits, strict=True)
    ]
    header = ("criterion at the start", "at the end", "steps", "converged", "within the travel")
    smooth = ""
    if done.task.criterion.name == "largest":
        smooth = (
            "What the search makes small in place of the largest U is the norm of power 24 of all "
            "of them, which has no kinks and lies a little above it; the best end is chosen by the "
            "largest U itself."
        )
    return Section(
        "Where the starts ended",
        ("Quasi-Newton search by exact gradient, best end first. Ends that agree speak for it.",),
        tables=(Table(header, rows, "rrrll"),) if rows else (),
        note=smooth,
    )
