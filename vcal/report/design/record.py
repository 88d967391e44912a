"""The machine-readable record of a designed measurement: the content of ``result.json``."""

import math
from collections.abc import Mapping
from typing import Any

from ...design.optimiser import Designed, Seen, Value, valuation
from ...study.study import Study
from ..html.text import number, percent, unit
from ..loop.record import plain, versions

DESIGN_SCHEMA = "vcal-design/1"


def design_sentence(done: Designed) -> str:
    """The answer in one sentence."""
    criterion = done.task.criterion
    before, after = (number(v.criterion) for v in (done.before, done.after))
    words = unit(criterion.unit)
    what = f"{criterion.words[0].upper()}{criterion.words[1:]}"
    if done.best is done.nominal:
        return f"The search found nothing better than the plan as it is: {before} {words}."
    return (
        f"{what}: {before} {words} with the plan as it is, {after} {words} with the designed one."
    )


def design_notes(done: Designed) -> list[str]:
    """What a reader has to know of how far this can be trusted."""
    found = []
    if done.best is done.nominal:
        found.append("No start led to a plan better than the present one, which was kept.")
    if not done.found:
        found.append("Nothing may vary by [design]; the plan is judged as it is.")
    out = len(done.fits) - sum(done.fits)
    if out:
        found.append(f"{out} of {len(done.fits)} starts ended out of the travel and do not count.")
    if done.prior is None:
        found.append(
            "Some errors have no prior, so that there is no error before the measurement to "
            "compare with."
        )
    return found


def design_record(
    done: Designed,
    seen: tuple[Seen, Seen],
    study: Study,
    *,
    seed: int,
    command: str = "",
    seconds: float = math.nan,
) -> dict[str, Any]:
    """Everything a program wants to know, as plain values; see `DESIGN_SCHEMA`."""
    task = done.task
    space = task.space
    found: dict[str, Any] = {
        "schema": DESIGN_SCHEMA,
        "name": study.name,
        "sentence": design_sentence(done),
        "notes": design_notes(done),
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
        "settings": {"seed": seed, "study": study.as_dict},
        "versions": versions(),
        "seconds": seconds,
        "input_files": dict(study.hashes),
        "command": command,
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


def duration(seconds: float) -> str:
    """A time as people say it: ``"2 h 05 min"``."""
    minutes = round(seconds / 60.0)
    if minutes < 1:
        return f"{seconds:.0f} s"
    return f"{minutes // 60} h {minutes % 60:02d} min" if minutes >= 60 else f"{minutes} min"


def share(value: float) -> str:
    """A share in percent, a dash where there is none."""
    return percent(value) if math.isfinite(value) else number(None)
