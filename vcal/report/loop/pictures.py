"""The pictures of a closed loop with their captions."""

from collections.abc import Iterator, Sequence

import numpy as np

from ... import plots
from ...geometry.error_motions import ErrorMotionTable
from ...identification.fit import Fit
from ...loop.empirical import EMPIRICAL, Changing
from ...loop.outcome.closure import Closure
from ...loop.weighing.cross_validation import held_apart
from ..html.picture import Picture
from ..html.text import number, percent
from .volumetric import LEAST_CHANGE_UM, VolumetricErrors, volumetric_errors

_DOTS = "Small dots: readings; large dots: group means with two standard errors."


def pictures(
    closure: Closure, tables: Sequence[ErrorMotionTable], errors: VolumetricErrors | None = None
) -> Iterator[Picture]:
    """All pictures in the order of the page; `errors` of the closure are computed where they are
    not given.
    """
    yield from _effects(closure)
    if closure.unexplained is not None:
        figure = plots.unexplained(closure.after, closure.unexplained)
        yield Picture.of("unexplained", "unexplained", _unexplained(closure), figure)
    yield from _errors(closure, errors or volumetric_errors(closure))
    if tables:
        figure = plots.error_motions(tables)
        caption = (
            "Identified error motions (error = actual − nominal, ISO 230-1 names). Blue band or "
            "bar: expanded uncertainty U (k = 2); grey: declared prior (± 2 standard deviations, "
            "cut off at the frame). "
        )
        if any(one.others for one in closure.alternatives):
            caption += (
                "Blue includes what alternatives, or a description of the unexplained residual, "
                "predict: the information from the data is in the table."
            )
        else:
            caption += "Where blue is as wide as grey, the data give no information."
        yield Picture.of("error_motions", "geometry", caption, figure)
    if closure.screenings:
        figure = plots.search(closure.screenings, float(closure.settings["alpha"]))
        yield Picture.of("search", "tried", _search(closure), figure)
    figure = plots.normal_plot(
        closure.before, closure.after, _enlarged(closure.before, closure.after)
    )
    caption = (
        "Normal probability plot of the studentised residuals of all fitted readings. On the line: "
        "noise as declared; steeper: larger than declared; curved at the ends: outliers or a "
        "missing effect."
    )
    yield Picture.of("noise", "noise", caption, figure)


def _search(closure: Closure) -> str:
    caption = (
        "Significance of the best candidate of every kind of effect, corrected for the whole "
        "search, in each round. Dashed: the limit alpha. Blue: the kind added in that round; "
        "orange: significant in that round and not added. Effects that only resemble an added one "
        "fall below the limit in the next round; the reasons for all others are listed below."
    )
    screened = {kind.kind for screening in closure.screenings for kind in screening.kinds}
    if drawn := sorted(screened & {cls.name for cls in EMPIRICAL}):
        caption += f" For comparison, no physical effects and never added: {', '.join(drawn)}."
    tried = [one.added for one in closure.screenings if one.added is not None]
    added = [found.effect for found in closure.effects]
    if dropped := [e.key for e in tried if not any(e.alike(one) for one in added)]:
        caption += f" Added and dropped again: {', '.join(dict.fromkeys(dropped))}."
    if elsewhere := [e.key for e in added if not any(e.alike(one) for one in tried)]:
        caption += (
            f" Identified in place of another one, beside all others, in no round of its own: "
            f"{', '.join(elsewhere)}."
        )
    return caption


def _enlarged(before: Fit, after: Fit) -> dict[str, float]:
    """Factor (median) by which the noise of every data set is larger in the second fit."""
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
        others = " (with the other identified effects)" if len(closure.effects) > 1 else ""
        caption = (
            f"Residual of the tool point {view.along}, without {key} on the left{others} and with "
            f"it on the right. {_DOTS} The means follow the pattern on the left; on the right they "
            "are zero where the effect explains it. "
        )
        if view.kind == "visible":
            caption += (
                f"Abscissa: change of the residual by {key} with station, poses and all other "
                "parameters refitted; no single column orders it as well."
            )
        else:
            caption += (
                f"Line: part of {key} that station, poses and all other parameters do not absorb."
            )
        # Zero-padded, so that files of ten or more effects sort in the order of identification.
        name = f"effect_{i:0{len(str(len(closure.effects)))}}_{key}"
        if data_set:
            name, caption = f"{name}_in_{data_set}", f"Data set {data_set}. {caption}"
        yield Picture.of(name, f"effect {i}", caption, plots.before_after(view, key))


def _unexplained(closure: Closure) -> str:
    what = closure.unexplained
    assert what is not None
    best = what.empirical
    if best is not None and plots.changing_sizes(closure.after, best) is not None:
        assert isinstance(best.effect, Changing)
        return (
            f"Size of {best.effect.effect.key} from parts of the readings, with two standard "
            "uncertainties. Line across: from all of them together; blue: by the empirical "
            "description, which describes the residual and does not explain it."
        )
    caption = f"Residual of the tool point that no effect explains. {_DOTS}"
    if what.where:
        caption += " Shaded: the interval in which it occurs."
    if what.empirical is not None:
        caption += (
            f" Right: remainder after an empirical description ({what.words}), which describes the "
            "residual and does not explain it."
        )
    return caption


def _errors(closure: Closure, found: VolumetricErrors) -> Iterator[Picture]:
    if found.check:
        assert closure.check is not None
        figure = plots.check_points(found.check, closure.check)
        caption = (
            "Residual volumetric error at the independent check points, after the best rigid "
            "alignment: nominal machine, declared model, and with the identified effects. One "
            "logarithmic colour scale; views from above (top) and from the front (bottom)."
        )
        yield Picture.of("check_points", "volumetric", caption, figure)
    if found.field is not None:
        figure = plots.field(found.field)
        caption = (
            "Identified volumetric error in three mid-planes of the travel, after rigid alignment "
            "(colour: length of the error vector; arrows: its component in the plane), and its "
            "standard uncertainty. Effects of direction, temperature or time are not included."
        )
        if found.changed > LEAST_CHANGE_UM:
            caption += f" Bottom: change by closing the loop, at most {number(found.changed)} µm."
        yield Picture.of("error_field", "volumetric", caption, figure)
    _, apart = held_apart(closure.after.model, closure.after.measurement)
    if np.any(apart):
        figure = plots.error_over_time({"before": closure.before, "after": closure.after})
        chosen = closure.after.measurement.holdout
        held = f"The last {percent(apart.mean())}" if chosen is None else chosen.words
        caption = (
            f"Three-dimensional error of every observation in the order of time. {held[0].upper()}"
            f"{held[1:]} were held out of every fit: faint dots are fitted, full ones predicted."
        )
        yield Picture.of("held_out", "volumetric", caption, figure)
