"""The pictures of a next measurement with their captions."""

from collections.abc import Iterator

from ...design.next_measurement import NextMeasurement
from ...plots.designs import angles_views, places_views, uncertainties
from ...plots.style import AFTER, BEFORE
from ..design.pictures import ANGLES, angles_of, in_space, of_lines, travel_of, uncertain, view_of
from ..html.picture import Picture


def pictures(done: NextMeasurement) -> Iterator[Picture]:
    """All pictures in the order of the page."""
    task, present = done.task, done.present
    so_far = task._replace(space=present)
    plans = (
        (so_far, present.nominal, "measured so far", BEFORE),
        (task, done.best.placed, "to be measured next", AFTER),
    )
    if in_space(task):
        caption = "Axis positions so far (left) and of the next measurement (right)."
        views = [view_of(*plan) for plan in plans]
        yield Picture.of("places", "places", caption, places_views(travel_of(task), views))
    turned = [angles_of(*plan) for plan in plans]
    if turned[0].travel:
        yield Picture.of("angles", "places", ANGLES, angles_views(turned))
    caption = (
        "Largest expanded uncertainty (k = 2) of every error along its axis: before any "
        "measurement (bar), from the data so far (orange), with the next measurement (blue)."
    ) + of_lines(task)
    rows = uncertain(task, done.prior, done.before, done.best.value)
    drawn = uncertainties(rows, ("data so far", "with the next"))
    yield Picture.of("uncertainties", "uncertainties", caption, drawn)
