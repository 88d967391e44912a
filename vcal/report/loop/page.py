"""The page of a closed loop: verdict, key figures, and the order of its sections."""

import math
from collections.abc import Mapping, Sequence

from ...compensation.computed_tests import LineTest
from ...geometry.acceptance import GeometricTest
from ...geometry.declared_machine import DeclaredMachine
from ...geometry.error_motions import ErrorMotionTable
from ...geometry.positioning_lines import PositioningTest
from ...loop.detectable import Detectable
from ...loop.outcome.closure import Closure
from ...study.identified_machine import stated_of
from ...study.study import Study
from ..html import text
from ..html.picture import Picture, by_section
from ..html.provenance import plain, provenance_section
from ..html.scene import Scene
from ..html.sheet import Badge, Tile, sheet
from ..machine.section import machine_sections
from .computed import computed_section
from .could_be_seen import could_be_seen_section
from .decision import Decided, acceptance_section, volumetric_section, volumetric_tiles
from .findings import data_sets, declared_effects, errors, identified, unexplained
from .geometry import conventions, geometry, noise
from .positioning import positioning_section
from .recorded import recorded_responses
from .standards import standards
from .tested import not_tested, tested
from .what_to_do import reaches, what_to_do

_BADGES = {
    "nothing_missing": Badge("Nothing was found", "good"),
    "named": Badge("Named"),
    "ambiguous": Badge("Ambiguous", "caution"),
    "unexplained": Badge("Unexplained", "bad"),
}
_INTERRUPTED = (
    "Interrupted. The search was stopped before its end; the page shows its state at that time."
)


def page(
    closure: Closure,
    study: Study,
    tables: Sequence[ErrorMotionTable],
    drawn: Sequence[Picture],
    tests: Sequence[GeometricTest] = (),
    positioned: Sequence[PositioningTest] = (),
    lines: Sequence[LineTest] = (),
    *,
    scenes: Sequence[Scene] = (),
    machine: DeclaredMachine | None = None,
    files: Mapping[str, str] | None = None,
    seen: Detectable | None = None,
    volumetric: Decided | None = None,
    command: str = "",
    seconds: float = math.nan,
) -> str:
    """The page as one self-contained HTML text, pictures included.

    `scenes` show the volumetric error in space; `machine` is the declared machine, whose pictures
    are among `drawn`; `files` describe the files beside it by their names; `seen` is what the
    measurement could have shown; `volumetric` the volumetric error with the decision on its
    tolerance; `seconds` is the run time of the loop.
    """
    shown = by_section(drawn)
    settings = {k: v for k, v in plain(closure.settings).items() if k != "effects"}
    quoted = {
        "settings": ", ".join(f"{key} = {value}" for key, value in settings.items()),
        "effects searched for": ", ".join(closure.searched) or "none",
    }
    return sheet(
        study.name,
        closure.sentence,
        [
            *acceptance_section(volumetric),
            *what_to_do(closure, reaches(closure)),
            errors(closure),
            *data_sets(closure, study),
            *identified(closure, shown),
            *recorded_responses(closure),
            *declared_effects(closure),
            *unexplained(closure, shown),
            *volumetric_section(volumetric, shown.get("volumetric", ()), tuple(scenes)),
            *tested(closure, study, shown),
            *not_tested(closure, study, seen),
            *could_be_seen_section(seen),
            *geometry(closure, study, tables, tests, shown),
            *standards(closure, study),
            *positioning_section(positioned),
            *computed_section(lines),
            noise(closure, shown),
            *machine_sections(machine, shown),
            conventions(study),
            provenance_section(study, quoted, files or {}, command, seconds),
        ],
        kicker="vcal – closing the loop with measured data",
        lead="" if volumetric is None else volumetric.sentence,
        badge=_badge(closure),
        facts=_facts(closure, study),
        warnings=[
            *([_INTERRUPTED] if closure.interrupted else []),
            *map(text.sentence_of, closure.notes),
        ],
        tiles=[*volumetric_tiles(volumetric), *_tiles(closure)],
    )


def _badge(closure: Closure) -> Badge:
    if closure.sizes is not None and closure.sizes.test.gross:
        return Badge("Machine not as declared", "bad")
    if closure.sizes is not None and closure.verdict == "nothing_missing":
        return Badge("Declared sizes do not fit", "caution")
    if closure.louder:
        return Badge("Noise larger than declared", "caution")
    return _BADGES[closure.verdict] if closure.verdict else Badge("Interrupted", "caution")


def _tiles(closure: Closure) -> list[Tile]:
    tiles = []
    stages = [closure.errors[name] for name in ("uncompensated", "before", "after")]
    for attribute, name in (("check", "Error at check points"), ("heldout", "Held-out error")):
        values = [getattr(stage, attribute) for stage in stages]
        if any(v is None or not math.isfinite(v.value) for v in values):
            continue
        uncompensated, before = (text.number(v.value) for v in values[:2])
        tiles.append(
            Tile(
                name,
                f"{text.with_uncertainty(values[2].value, values[2].u)} µm",
                f"declared model {before} µm, uncompensated {uncompensated} µm",
            )
        )
    before, after = (text.number(stage.chi2_per_dof) for stage in stages[1:])
    note = f"declared model {before}; 1 is the declared noise"
    return [*tiles, Tile("χ² per degree of freedom", after, note)]


def _facts(closure: Closure, study: Study) -> list[tuple[str, str]]:
    after = closure.after
    plan = after.measurement.plan
    used = int(after.used.sum())
    held = f", {plan.rows - used} of them held out or left out" if used < plan.rows else ""
    check = len(closure.check.tool_point) if closure.check is not None else 0
    stated = stated_of(study)
    return [
        ("Machine", ", ".join([study.chain.text, *_named(stated.get("machine", {}))])),
        *([("Measured", ", ".join(measured))] if (measured := _measured(stated)) else []),
        study.observers,
        ("Measurement", study.observations + held),
        ("Check points", str(check) if check else "none"),
        ("Parameters", f"{len(closure.before.theta)} declared, {len(after.theta)} in the end"),
    ]


def _named(machine: Mapping[str, str]) -> list[str]:
    """Manufacturer, type and serial number, those that are stated."""
    made = " ".join(machine[key] for key in ("manufacturer", "model") if key in machine)
    number = machine.get("serial_number")
    return [*([made] if made else []), *([f"serial number {number}"] if number else [])]


def _measured(stated: Mapping[str, Mapping[str, str]]) -> list[str]:
    given = stated.get("measurement", {})
    who = given.get("operator")
    return [*([given["date"]] if "date" in given else []), *([f"by {who}"] if who else [])]
