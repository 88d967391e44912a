"""The pictures of a report, each with a caption that says what to see in it."""

from collections.abc import Iterator, Sequence

import numpy as np

from ... import plots
from ...geometry.error_motions import ErrorMotionTable
from ...identification.fit import Fit
from ...loop.empirical import EMPIRICAL, Changing
from ...loop.outcome.closure import Closure
from ..html.picture import Picture
from ..html.text import number, percent

_DOTS = "Small dots: readings; large: means of groups with two standard errors."


def pictures(closure: Closure, tables: Sequence[ErrorMotionTable]) -> Iterator[Picture]:
    """All pictures of a closure, in the order of the page."""
    yield from _effects(closure)
    if closure.unexplained is not None:
        figure = plots.unexplained(closure.after, closure.unexplained)
        yield Picture("unexplained", "unexplained", _unexplained(closure), plots.png(figure))
    yield from _errors(closure)
    if tables:
        figure = plots.error_motions(tables)
        caption = (
            "Identified error motions (error = actual − nominal, ISO 230-1 names). Blue band or "
            "bar: expanded uncertainty U (k = 2); grey: what was declared before the measurement "
            "(± 2 standard deviations, cut off at the frame). "
        )
        if any(one.others for one in closure.alternatives):
            caption += (
                "Blue holds what rivals, or a description of what is unexplained, would foretell "
                "instead: how much the data said is in the table."
            )
        else:
            caption += "Where blue is as wide as grey, the data said nothing."
        yield Picture("error_motions", "geometry", caption, plots.png(figure))
    if closure.screenings:
        figure = plots.search(closure.screenings, float(closure.settings["alpha"]))
        yield Picture("search", "tried", _search(closure), plots.png(figure))
    figure = plots.normal_plot(
        closure.before, closure.after, _enlarged(closure.before, closure.after)
    )
    caption = (
        "Residuals of all fitted readings over the standard deviations they should have, against "
        "those of normal noise. On the line: noise as declared; steeper: larger than declared; "
        "bent at the ends: stray readings or something that is missing."
    )
    yield Picture("noise", "noise", caption, plots.png(figure))


def _search(closure: Closure) -> str:
    caption = (
        "Significance of the best candidate of every kind of effect, corrected for the whole "
        "search, in each round. Dashed: the limit alpha. Blue: the kind that was added in that "
        "round; orange: significant in it, and not added. What an added effect had mimicked falls "
        "below the limit beside it; why the rest was not added is told below."
    )
    screened = {kind.kind for screening in closure.screenings for kind in screening.kinds}
    if drawn := sorted(screened & {cls.name for cls in EMPIRICAL}):
        caption += f" For comparison, no effects and never added: {', '.join(drawn)}."
    tried = [one.added for one in closure.screenings if one.added is not None]
    added = [found.effect for found in closure.effects]
    if dropped := [e.key for e in tried if not any(e.alike(one) for one in added)]:
        caption += f" Added and dropped again: {', '.join(dict.fromkeys(dropped))}."
    if anew := [e.key for e in added if not any(e.alike(one) for one in tried)]:
        caption += (
            f" Found in the place of another, beside all others, in no round of its own: "
            f"{', '.join(anew)}."
        )
    return caption


def _enlarged(before: Fit, after: Fit) -> dict[str, float]:
    """By how much the noise of every data set is larger in the second fit (median)."""
    both = before.counted & after.counted
    sizes = [np.einsum("nii->ni", fit.whitener) for fit in (before, after)]
    return {
        name: float(np.median((sizes[0] / np.where(both, sizes[1], 1.0))[both & rows[:, None]]))
        for name, rows in after.measurement.plan.parts.items()
    }


def _effects(closure: Closure) -> Iterator[Picture]:
    plan = closure.after.measurement.plan
    shown = [
        (i, found, name, rows)
        for i, found in enumerate(closure.effects, start=1)
        for name, rows in plan.parts.items()
        if (found.effect.rows(plan) & closure.after.used & rows).any()
    ]
    for i, found, data_set, rows in shown:
        key = found.effect.key
        view = plots.effect_view(closure.after, found.effect, rows)
        others = " (with the other effects that were found)" if len(closure.effects) > 1 else ""
        caption = (
            f"Residual of the tool point {view.along}, without {key} on the left{others} and with "
            f"it on the right. {_DOTS} On the left the means follow the pattern; on the right they "
            "lie on zero where the effect explains it. "
        )
        if view.kind == "visible":
            caption += (
                f"Abscissa: what {key} changes in the residual once station, poses and all other "
                "parameters have taken up their share of it; no single column orders it as well."
            )
        else:
            caption += f"Line: what station, poses and all other parameters leave of {key}."
        # Of ten or more the names of the files are in the order in which they were found, too.
        name = f"effect_{i:0{len(str(len(closure.effects)))}}_{key}"
        if data_set:
            name, caption = f"{name}_in_{data_set}", f"Data set {data_set}. {caption}"
        yield Picture(name, f"effect {i}", caption, plots.png(plots.before_after(view, key)))


def _unexplained(closure: Closure) -> str:
    what = closure.unexplained
    assert what is not None
    best = what.empirical
    if best is not None and plots.changing_sizes(closure.after, best) is not None:
        assert isinstance(best.effect, Changing)
        return (
            f"What parts of the readings say of {best.effect.effect.key}, with two standard "
            "uncertainties. Black: what all of them say together; blue: its size by the empirical "
            "description, which describes and does not explain."
        )
    caption = f"Residual of the tool point that no effect explains. {_DOTS}"
    if what.where:
        caption += " Shaded: the interval in which it sits."
    if what.empirical is not None:
        caption += (
            f" Right: what an empirical description ({what.words}) leaves of it, which describes "
            "and does not explain."
        )
    return caption


def _errors(closure: Closure) -> Iterator[Picture]:
    fits = {"uncompensated": closure.nominal, "before": closure.before, "after": closure.after}
    if closure.check is not None and closure.check.tool_point.shape[0] >= 3:
        errors = plots.check_errors(fits, closure.check)
        figure = plots.check_points(errors, closure.check)
        caption = (
            "Volumetric error that remains at the independent check points, after the best rigid "
            "alignment: nominal machine, declared model, and with what was found. One logarithmic "
            "colour scale throughout; seen from above (top) and from the front (bottom)."
        )
        yield Picture("check_points", "volumetric", caption, plots.png(figure))
    values = plots.error_field(closure.before, closure.after, closure.check, closure.alternatives)
    if values is not None:
        figure = plots.field(values)
        caption = (
            "Identified volumetric error in three mid-planes of the travel, after rigid alignment "
            "(colour: length of the error vector; arrows: its part in the plane), and its standard "
            "uncertainty. Only what depends on the axis positions alone: effects of direction, "
            "temperature or time come on top."
        )
        largest = np.linalg.norm(values.change, axis=-1).max()
        if largest > 1e-3:
            caption += f" Bottom: what closing the loop changed, at most {number(largest)} µm."
        yield Picture("error_field", "volumetric", caption, plots.png(figure))
    folds, apart = closure.after.model.instrument.folds(closure.after.measurement.plan)
    if np.any(apart):
        figure = plots.error_over_time({"before": closure.before, "after": closure.after})
        share = percent((folds >= 0).mean())
        caption = (
            f"3-D error of every observation in the order of time. The last {share} were held out "
            "of every fit: faint dots were fitted, full ones predicted."
        )
        yield Picture("held_out", "volumetric", caption, plots.png(figure))
