"""The record of a designed measurement for programs: the content of ``result.json``."""

import math
from collections.abc import Mapping
from typing import Any

from ...design.optimiser import Designed, Seen, Value, valuation
from ...study.study import Study
from ..html.provenance import plain, provenance_record
from ..html.text import number, unit

DESIGN_SCHEMA = "vcal-design/1"


def sentence(done: Designed) -> str:
    """The answer in one sentence."""
    criterion = done.task.criterion
    before, after = (number(v.criterion) for v in (done.before, done.after))
    words = unit(criterion.unit)
    what = f"{criterion.words[0].upper()}{criterion.words[1:]}"
    if done.best is done.nominal:
        return f"The search found no better plan than the present one: {before} {words}."
    return f"{what}: {before} {words} with the present plan, {after} {words} with the designed one."


def notes(done: Designed) -> list[str]:
    """Limitations of the results."""
    found = []
    if done.best is done.nominal:
        found.append("No start led to a better plan; the present one was kept.")
    if not done.found:
        found.append("[design] lets nothing vary; the present plan is evaluated.")
    out = len(done.fits) - sum(done.fits)
    if out:
        found.append(f"{out} of {len(done.fits)} starts ended outside the travel and do not count.")
    if done.prior is None:
        found.append(
            "Some errors have no prior; therefore there is no error before the measurement to "
            "compare with."
        )
    return found


def record(
    done: Designed,
    seen: tuple[Seen, Seen],
    study: Study,
    *,
    seed: int,
    command: str = "",
    seconds: float = math.nan,
) -> dict[str, Any]:
    """All results as plain values; see `DESIGN_SCHEMA`."""
    task = done.task
    space = task.space
    found: dict[str, Any] = {
        "schema": DESIGN_SCHEMA,
        "name": study.name,
        "sentence": sentence(done),
        "notes": notes(done),
        "goal": task.criterion.name,
        "criterion": {"words": task.criterion.words, "unit": task.criterion.unit},
        "nominal": _plan(done, done.before, done.nominal, seen[0], done.worse_before),
        "designed": _plan(done, done.after, done.best, seen[1], done.worse_after),
        "prior": None if done.prior is None else _value(done, done.prior),
        "gain": done.gain,
        "starts": [
            {
                "start": f.start,
                "end": f.value,
                "steps": f.iterations,
                "converged": f.converged,
                "fits": fits,
                "message": f.message,
            }
            for f, fits in zip(done.found, done.fits, strict=True)
        ],
        "group": space.group,
        **provenance_record(study, {"seed": seed}, command, seconds),
    }
    return plain(found)


def _plan(done: Designed, value: Value, placed: Any, seen: Seen, worse: Any) -> Mapping[str, Any]:
    space = done.task.space
    return _value(done, value) | {
        "valuation": valuation(value, done.prior),
        "rank": seen.rank,
        "columns": seen.columns,
        "unseen": list(seen.unseen),
        "measuring_seconds": space.seconds(placed),
        f"worse_without_{space.group}": {
            str(g): float(w) for g, w in zip(space.groups, worse, strict=True)
        },
    }


def _value(done: Designed, value: Value) -> dict[str, Any]:
    motions = done.task.families[0].motions
    return {
        "criterion": value.criterion,
        "rms_um": value.aligned_um,
        "rms_raw_um": value.raw_um,
        "largest_U": {m.name: float(u) for m, u in zip(motions, value.largest, strict=True)},
    }
