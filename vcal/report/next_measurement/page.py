"""The page of a next measurement: what to measure in addition to the data."""

import math
from collections.abc import Sequence

import numpy as np

from ...design.next_measurement import NextMeasurement
from ...design.separation import ALPHA, Lambda, Separation
from ...geometry.declared_machine import DeclaredMachine
from ...study.design.written_plan import plan_table
from ...study.study import Study
from ...words import counted
from ..design.page import CONVENTIONS, FILES, tiles
from ..html import text
from ..html.picture import Picture, by_section
from ..html.provenance import provenance_section
from ..html.sheet import Badge, Section, Table, sheet
from ..machine.section import machine_sections
from .record import carried_over, centre, conditions_of, decrease, lambda_text, lambdas, sentence

_TESTS = (
    "Non-centrality λ of A against B: the expected increase of χ² when A is present with the size "
    "given, and B is fitted in its place with the declared model, all priors included: a′ G a with "
    "the G of the score test of the loop. Power: probability that this test rejects B at "
    f"{100 * ALPHA:g} %, for one effect at one placement; the loop, which tests all placements, "
    "needs more."
)


def page(
    done: NextMeasurement,
    study: Study,
    drawn: Sequence[Picture],
    *,
    seed: int,
    machine: DeclaredMachine | None = None,
    why: str,
    command: str = "",
    seconds: float = math.nan,
) -> str:
    """The page as one self-contained HTML text, pictures included.

    The pictures of the declared `machine` are among `drawn`.
    """
    shown = by_section(drawn)
    task, present, apart = done.task, done.present, done.separation
    rows = counted(study.plan.rows, "row")
    sections = [
        _candidates(done),
        Section(
            "Next measurement",
            (
                "plan.csv beside this page holds the rows to be measured, and only those. "
                + carried_over(done, study),
            ),
            tables=(_conditions(done, study),) if apart is not None else (),
            pictures=shown.get("places", ()),
        ),
        Section("Uncertainty of every error", pictures=shown["uncertainties"]),
        *machine_sections(machine, shown),
        Section("Frames, signs, units", points=(*CONVENTIONS, _TESTS)),
        provenance_section(study, {"seed": f"{seed}"}, FILES, command, seconds),
    ]
    if apart is not None and done.separated is not None:
        sections.insert(0, _rivals(apart, done.separated, lambdas(done.best)))
    return sheet(
        study.name,
        sentence(done),
        sections,
        kicker="vcal – what to measure next",
        badge=Badge("Next", "plain"),
        facts=[
            ("Machine", study.chain.text),
            study.observers,
            ("So far", f"{counted(len(present.groups), present.group)}, {rows}"),
            ("Next", counted(len(task.space.groups), task.space.group)),
            ("Goal", _goal(done, study.single.design.goal)),
            ("Reason", why),
            ("Measuring time", text.duration(task.space.seconds(done.best.placed))),
        ],
        tiles=tiles(
            task,
            ("data so far", "next measurement"),
            (done.before, done.best.value),
            decrease(done, done.best),
            done.prior,
        ),
    )


def _goal(done: NextMeasurement, goal: str) -> str:
    if done.separation is None:
        return f"{goal}: {done.task.criterion.words}"
    first, second = (r.effect.key for r in done.separation.rivals)
    return f"distinguish {first} from {second}"


def _rivals(separation: Separation, before: Lambda, after: Lambda) -> Section:
    first, second = (r.effect.key for r in separation.rivals)
    powers = [separation.powers(x) for x in (before, after)]
    rows = [
        (
            present,
            fitted,
            "as given" if separation.rivals[i].sized else "of its prior",
            *(lambda_text(x[i]) for x in (before, after)),
            *(text.percent(power[i]) for power in powers),
        )
        for i, (present, fitted) in enumerate(((first, second), (second, first)))
    ]
    header = (
        "present", "fitted instead", "size", "λ so far", "λ then", "power so far", "power then",
    )  # fmt: skip
    return Section(
        "Distinguishing the two effects", tables=(Table(header, rows, "lllrrrr"),), note=_TESTS
    )


def _candidates(done: NextMeasurement) -> Section:
    apart = done.separation is not None
    rows = []
    for number, c in enumerate(done.candidates, start=1):
        at = centre(done, c)
        rows.append(
            (
                str(number),
                text.number(c.value.criterion, 4),
                text.percent(decrease(done, c)),
                *([lambda_text(lambdas(c).smaller)] if apart else []),
                ", ".join(f"{v:.0f}" for v in at) if at else "",
            )
        )
    header = (
        "", "criterion then", "decrease", *(["smaller λ"] if apart else []), "centre, X Y Z in mm",
    )  # fmt: skip
    way = (
        f"Best of {done.drawn} random candidates; the best {len(rows)} of them were improved by a "
        "gradient search."
        if done.differentiable
        else f"Best of {done.drawn} random candidates, none of them moved: the effect cannot be "
        "differentiated with respect to positions."
    )
    table = Table(header, rows, "r" * len(header))
    return Section("Candidates, best first", (way,), tables=(table,))


def _conditions(done: NextMeasurement, study: Study) -> Table:
    """The columns of plan.csv, other than positions, on which the effects depend."""
    columns = plan_table(study, done.task.space, done.best.placed)
    rows = [
        (name, *(text.number(float(end(columns[name])), 4) for end in (np.min, np.max)))
        for name in sorted(conditions_of(done, study) & columns.keys())
    ]
    note = "Columns of plan.csv, in the units of their names."
    return Table(("condition", "lowest", "highest"), rows, "lrr", note=note)
