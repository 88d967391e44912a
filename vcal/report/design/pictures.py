"""The pictures of a designed measurement with their captions."""

from collections.abc import Iterator
from typing import Any

import numpy as np

from ...design.optimiser import Designed, Task, Value
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
from ...plots.style import AFTER, BEFORE
from ..html.picture import Picture

ANGLES = (
    "Angles of the rotary axes in every row, over their travel; a single rotary axis over the rows."
)


def pictures(done: Designed) -> Iterator[Picture]:
    """All pictures in the order of the page."""
    task = done.task
    space = task.space
    plans = ((task, done.nominal, "present", BEFORE), (task, done.best, "designed", AFTER))
    if in_space(task):
        caption = (
            "Axis positions during the measurement, of the present plan (left) and of the designed "
            "one (right); the box is the travel."
        )
        views = [view_of(*plan) for plan in plans]
        yield Picture.of("places", "places", caption, places_views(travel_of(task), views))
    turned = [angles_of(*plan) for plan in plans]
    if turned[0].travel:
        yield Picture.of("angles", "places", ANGLES, angles_views(turned))
    before, after = space.artefact(done.nominal), space.artefact(done.best)
    if before is not None and after is not None:
        caption = (
            "Balls of the present and of the designed artefact from two sides, with their numbers."
        )
        yield Picture.of("artefact", "artefact", caption, artefact_views(before, after))
    caption = (
        "Largest expanded uncertainty (k = 2) of every error motion and squareness along its axis: "
        "before any measurement (bar), with the present plan (orange), as designed (blue)."
    ) + of_lines(task)
    rows = uncertain(task, done.prior, done.before, done.after)
    drawn = uncertainties(rows, ("present plan", "designed"))
    yield Picture.of("uncertainties", "uncertainties", caption, drawn)
    caption = f"Increase of the criterion when one {space.group} is left out."
    drawn = worth(space.groups, done.worse_after, space.group)
    yield Picture.of("worth", "worth", caption, drawn)


def of_lines(task: Task) -> str:
    """Sentence for a caption that names the errors of lines through the tool point's paths."""
    names = [m.name for m in task.families[0].motions if not m.amplitudes]
    if not names:
        return ""
    return (
        f" {', '.join(names)}: of the least-squares lines through the tool point's paths (ISO "
        "230-1), irrespective of the parameters that they are divided between."
    )


def uncertain(task: Task, prior: Value | None, before: Value, after: Value) -> list[Uncertain]:
    """The largest uncertainty of every error: before any measurement, and with two plans."""
    motions = task.families[0].motions
    priors = np.full(len(motions), np.nan) if prior is None else prior.largest
    rows = zip(motions, priors, before.largest, after.largest, strict=True)
    return [Uncertain(m.name, m.unit, float(p), float(b), float(a)) for m, p, b, a in rows]


def in_space(task: Task) -> bool:
    """Whether the machine has axes X, Y and Z, so that positions can be drawn."""
    return set("XYZ") <= set(task.families[0].model.chain.axes)


def angles_of(task: Task, placed: Any, name: str, colour: str) -> Angles:
    """Angles of the rotary axes of a machine tool in a plan; empty without rotary axes."""
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
    """Positions of a plan, with the rows that belong together."""
    space = task.space
    plan = space.plan(placed)
    position = np.column_stack([np.asarray(plan.x(axis)) for axis in "XYZ"])
    group = np.asarray(plan.groups.get(space.group, np.arange(plan.rows)))
    group = group if len(np.unique(group)) == len(space.groups) else np.arange(plan.rows)
    return Places(name, position, group, space.station(placed), colour)
