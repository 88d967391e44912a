"""The pictures of a designed measurement."""

from collections.abc import Iterator
from typing import Any

import numpy as np

from ...design.optimiser import Designed, Task
from ...plots.designs import (
    Angles,
    Places,
    Uncertain,
    angles_views,
    artefact_views,
    places_views,
    uncertainties,
    worth,
)
from ...plots.style import AFTER, BEFORE, png
from ..html.picture import Picture

ANGLES = (
    "Where the rotary axes stand in every row, over their travel; with one rotary axis, in the "
    "order of the rows."
)


def design_pictures(done: Designed) -> Iterator[Picture]:
    """All pictures, in the order of the page."""
    task = done.task
    space = task.space
    if in_space(task):
        views = [
            view_of(task, done.nominal, "as it is", BEFORE),
            view_of(task, done.best, "designed", AFTER),
        ]
        caption = (
            "Where the axes stand during the measurement, as the plan is (left) and as it was "
            "designed (right); the box is the travel."
        )
        yield Picture("places", "places", caption, png(places_views(travel_of(task), views)))
    turned = [
        angles_of(task, done.nominal, "as it is", BEFORE),
        angles_of(task, done.best, "designed", AFTER),
    ]
    if turned[0].travel:
        yield Picture("angles", "angles", ANGLES, png(angles_views(turned)))
    before, after = space.artefact(done.nominal), space.artefact(done.best)
    if before is not None and after is not None:
        caption = (
            "Balls of the artefact from two sides, as it is and as designed, with their numbers."
        )
        yield Picture("artefact", "artefact", caption, png(artefact_views(before, after)))
    caption = (
        "Largest expanded uncertainty (k = 2) of every error motion and squareness along its axis: "
        "before any measurement (bar), with the plan as it is (orange), as designed (blue)."
    ) + of_lines(done.task)
    drawn = uncertainties(uncertain(done), ("plan as it is", "designed"))
    yield Picture("uncertainties", "uncertainties", caption, png(drawn))
    caption = f"By how much the criterion gets worse when one {space.group} is left out."
    yield Picture(
        "worth", "worth", caption, png(worth(space.groups, done.worse_after, space.group))
    )


def of_lines(task: Task) -> str:
    """For a caption: which of the errors are of lines through the tool point's paths, if any."""
    names = [m.name for m in task.families[0].motions if not m.amplitudes]
    if not names:
        return ""
    return (
        f" {', '.join(names)}: of the least-squares lines through the tool point's paths (ISO "
        "230-1), whatever parameters they are shared out to."
    )


def uncertain(done: Designed) -> list[Uncertain]:
    """Every error with what is left of it."""
    motions = done.task.families[0].motions
    prior = np.full(len(motions), np.nan) if done.prior is None else done.prior.largest
    rows = zip(motions, prior, done.before.largest, done.after.largest, strict=True)
    return [Uncertain(m.name, m.unit, float(p), float(b), float(a)) for m, p, b, a in rows]


def in_space(task: Task) -> bool:
    """Whether the machine has the axes X, Y and Z, whose positions can be drawn."""
    return set("XYZ") <= set(task.families[0].model.chain.axes)


def angles_of(task: Task, placed: Any, name: str, colour: str) -> Angles:
    """Where the rotary axes of a machine tool stand in a plan; none on a machine without."""
    chain, plan = task.families[0].model.chain, task.space.plan(placed)
    turning = [joint for joint in chain.joints if joint.kind == "rotary"]
    return Angles(
        name,
        {joint.name: np.rad2deg(np.asarray(plan.x(joint.name))) for joint in turning},
        {joint.name: np.rad2deg(np.asarray(joint.travel)) for joint in turning},
        colour,
    )


def travel_of(task: Task) -> np.ndarray:
    """Travel of X, Y and Z, m."""
    chain = task.families[0].model.chain
    return np.stack([chain.joint(axis).travel for axis in "XYZ"])


def view_of(task: Task, placed: Any, name: str, colour: str) -> Places:
    """A plan as it is drawn."""
    space = task.space
    plan = space.plan(placed)
    position = np.column_stack([np.asarray(plan.x(axis)) for axis in "XYZ"])
    group = np.asarray(plan.groups.get(space.group, np.arange(plan.rows)))
    group = group if len(np.unique(group)) == len(space.groups) else np.arange(plan.rows)
    return Places(name, position, group, space.station(placed), colour)
