"""What a plan of a space tells apart, by name."""

from typing import Any, NamedTuple

from ..model import Model
from .optimise import Task
from .rank import rank_of


class Seen(NamedTuple):
    """Rank of all readings by all amplitudes and unknown poses, without any prior."""

    columns: int
    rank: int
    unseen: tuple[str, ...]
    """Errors and effects that are part of what no reading shows."""


def seen(task: Task, placed: Any) -> Seen:
    """Of a plan, by the study's own family."""
    space, model = task.space, task.families[0].model
    plan, instrument = space.plan(placed), space.instrument(placed)
    nuisances = [e for e in instrument.effects(plan) if e.kind == "nuisance"]
    whole = Model(model.chain, instrument, (*model.effects, *nuisances))
    found = rank_of(whole, plan)
    names = []
    for i in found.mixed:
        entry = whole.entries[i]
        if i < len(model.entries):
            own = entry.parameter.name.split(".")[0]
            names.append(own if entry.key == "geometric" else entry.key)
    return Seen(found.columns, found.rank, tuple(dict.fromkeys(names)))
