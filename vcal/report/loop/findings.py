"""Sections of the page: errors, identified and declared effects, the unexplained residual."""

import numpy as np

from ...loop.outcome.closure import Closure, FoundEffect
from ...plots import column_of
from ...study.study import Study
from ..html import text
from ..html.picture import Picture, Shown
from ..html.sheet import Badge, Section, Table, Tone
from .derived import (
    FEW,
    Listed,
    declared,
    in_short,
    intervals_in_file,
    parameters,
    shares_by_column,
    untested_beside,
    untested_in_words,
)
from .own_effect import FILE, own_effect
from .tested import restricted

_LEAST = 0.0005
"""Probability below which an alternative is left out: it would be printed as 0.0 %."""
_TONES: dict[str, Tone] = {"named": "plain", "ambiguous": "caution"}
_METRICS = (
    ("Check points, rms after rigid alignment", "µm", "check"),
    ("Check points, rms without alignment", "µm", "check_raw"),
    ("Held-out readings, rms per point", "µm", "heldout"),
    ("Fitted readings, rms per point", "µm", "fit"),
    ("χ² per degree of freedom, declared noise", "", "chi2_per_dof"),
)
_IN_UNCERTAINTY = (
    "is part of the uncertainty of the error at the check points, of the error motions and of the "
    "error field."
)


def errors(closure: Closure) -> Section:
    """Every error measure of the nominal, the declared and the final model."""
    rows = []
    for name, unit, attribute in _METRICS:
        cells = []
        for stage in ("uncompensated", "before", "after"):
            found = getattr(closure.errors[stage], attribute)
            if found is None or isinstance(found, float):
                cells.append(text.number(found))
            else:
                cells.append(text.with_uncertainty(found.value, found.u))
        if any(cell != text.DASH for cell in cells):
            rows.append((name, *cells, unit))
    check = (
        "Check points are independent: no fit uses them. They are compared after the best rigid "
        "alignment, because an unknown station or pose leaves six rigid degrees of freedom "
        "unobservable. "
    )
    header = (
        "", "uncompensated", "before (declared model)", "after (identified effects added)", "unit",
    )  # fmt: skip
    return Section(
        "Error before and after",
        tables=(Table(header, rows, "lrrrl"),),
        note="± one standard uncertainty. Uncompensated: the nominal machine, only station, poses "
        "and tool points fitted. "
        + (check if closure.check is not None else "")
        + "Held-out readings are predicted by fits that did not use them; they include the noise "
        "of the instrument.",
    )


def data_sets(closure: Closure, study: Study) -> list[Section]:
    """Contents and errors of each data set; no section for a study with a single one."""
    before, after = (closure.errors[name].sets for name in ("before", "after"))
    fit = closure.after
    rows = []
    for one in study.sets:
        if not one.name:
            continue
        both = (before[one.name], after[one.name])
        rows.append(
            (
                one.name,
                one.settings.kind.replace("_", " "),
                one.file,
                str(int(fit.counted[fit.measurement.plan.in_set(one.name)].sum())),
                *(text.number(e.fit.value) for e in both),
                *(text.with_uncertainty(e.heldout.value, e.heldout.u) for e in both),
                *(text.number(e.chi2_per_dof) for e in both),
            )
        )
    header = (
        "data set", "instrument", "table", "fitted readings", "fitted, rms µm, before", "after",
        "held out, rms µm, before", "after", "χ² / dof, before", "after",
    )  # fmt: skip
    note = (
        "One machine and one model for all data sets; station, poses, offsets and effects of an "
        "instrument belong to its own data set and carry its name. rms: per point. χ² of a data "
        "set is divided by the number of its readings minus its share of the parameters."
    )
    table = Table(header, rows, "lllrrrrrrr", note=note)
    return [Section("Data sets", tables=(table,), minor=True)] if rows else []


def identified(closure: Closure, shown: Shown) -> list[Section]:
    """A heading and a subsection for every effect that was found, then the same for hints."""
    sections = {
        found.effect.key: _effect(closure, found, shown.get(f"effect {i}", ()))
        for i, found in enumerate(closure.effects, start=1)
    }
    own = [sections[one.effect.key] for one in closure.found]
    hints = [sections[one.effect.key] for one in closure.hints]
    rows = [
        (one.name, text.percent(one.probability), f"{one.hint[0].upper()}{one.hint[1:]}.")
        for one in closure.hints
    ]
    about = (
        "These effects were added to the model and do not count as found. What is compensated for "
        "each is the average of the effects that it may be, weighted by their probabilities."
    )
    table = Table(("effect", "probability", "why it is a hint only"), rows, "lrl")
    return [
        *([Section("Identified effects"), *own] if own else []),
        *([Section("Hints", (about,), tables=(table,)), *hints] if hints else []),
    ]


def _effect(closure: Closure, found: FoundEffect, drawn: tuple[Picture, ...]) -> Section:
    caption = ""
    if found.joint:
        caption = (
            f"Values for {found.effect.key}; for another effect of this class, size and sign may "
            "differ:"
        )
    rows = [(name, *_stated(value, u, unit)) for name, value, unit, u in parameters(closure, found)]
    tables = [Table(("parameter", *text.STATED), rows, "lrrrl", caption=caption)]
    if remarks := _remarks(closure, found):
        tables.append(Table(("", ""), remarks))
    rivals = [
        (f"{name} {placement}".strip(), text.percent(p))
        for name, placement, p in found.alternatives
        if p >= _LEAST
    ]
    if rivals:
        caption = "Alternatives that the readings do not exclude:"
        note = f"What they predict {_IN_UNCERTAINTY}"
        header = ("alternative", "posterior probability")
        tables.append(Table(header, rivals, "lr", caption=caption, note=note))
    statistics = (
        f"Corrected p-value {text.probability(found.p_value)}; gain in log evidence "
        f"{text.number(found.log_evidence)}; ΔBIC {text.number(found.delta_bic)}; the held-out "
        f"rms {_gain(closure, found)}."
    )
    return Section(
        f"{found.effect.name} {found.placement}".strip(),
        (f"{text.sentence_of(found.effect.summary)} {statistics}",),
        tables=tuple(tables),
        pictures=drawn,
        minor=True,
        badge=Badge(found.status, _TONES[found.status]),
    )


def _remarks(closure: Closure, found: FoundEffect) -> list[tuple[str, str]]:
    """What limits the identification of an effect, in terms and descriptions."""
    rows = []
    several = any(p >= _LEAST for *_, p in found.alternatives) or bool(found.equivalent)
    if found.equivalent:
        what = (
            f"{', '.join(found.equivalent)}. They displace the readings alike, up to size and "
            "sign; any one of them may be the cause."
        )
        rows.append(("Cannot be distinguished with these data", what))
    elif not several:
        none = f"none with a posterior probability of {100 * _LEAST:g} % or more"
        rows.append(("Alternatives", none))
    if found.separation:
        term = "To distinguish them" if several else "To confirm it"
        rows.append((term, text.sentence_of(found.separation)))
    if untested := untested_in_words(untested_beside(closure, found)):
        what = (
            f"{untested}. If one of these effects is present, it may appear as the effect "
            "identified here."
        )
        rows.append(("Not tested on the same axis because columns are missing", what))
    return rows


def _gain(closure: Closure, found: FoundEffect) -> str:
    """By how much the held-out rms fell: ``"fell by 20 % when it was added"``."""
    plan = closure.after.measurement.plan
    verb = "fell" if found.heldout_gain >= 0.0 else "rose"
    words = f"{verb} by {text.percent(abs(found.heldout_gain))} when it was added"
    if len(plan.parts) == 1:
        return words
    rows = np.asarray(found.effect.rows(plan))
    own = [name for name, inside in plan.parts.items() if (inside & rows).any()]
    of = "in the data set with the largest decrease" if own[1:] else f"in the data set {own[0]}"
    return f"{words} ({of})"


def declared_effects(closure: Closure) -> list[Section]:
    """Declared effects with their final values; folded where an effect has many parameters."""
    found = declared(closure)
    few = [
        row for effect, listed in found if len(listed) <= FEW for row in _rows(effect.key, listed)
    ]
    header = ("effect", "parameter", *text.STATED)
    tables = [Table(header, few, "llrrrl")]
    for effect, listed in found:
        if len(listed) > FEW:
            fold = f"{effect.key}: {in_short(effect, listed)}"
            tables.append(Table(header, _rows(effect.key, listed), "llrrrl", fold=fold))
    about = "Effects declared in the study, with the values of the final fit. Known values have no "
    return [Section("Declared effects", (about + "uncertainty.",), tables=(*tables,))] * bool(found)


def _rows(key: str, listed: Listed) -> list[tuple[str, ...]]:
    return [(key, name, *_stated(value, u, unit)) for name, value, unit, u in listed]


def _stated(value: float, u: float, unit: str) -> tuple[str, ...]:
    """The cells of a parameter, whose unit may be 1."""
    *cells, printed = text.stated(value, u, unit)
    return (*cells, printed or "1")


def unexplained(closure: Closure, shown: Shown) -> list[Section]:
    """What is significant and has no identified cause; no section where there is nothing."""
    what = closure.unexplained
    if what is None:
        return []
    plan = closure.after.measurement.plan
    about = f"{text.sentence_of(what.reason)} No effect is identified for it"
    if not closure.full and not closure.interrupted:
        asked = restricted(closure)
        asked = f", {asked}," if asked else ""
        about += f": none of the effects that were tested{asked} explains it"
    paragraphs = [f"{about}."]
    if own_effect(closure) is not None:
        paragraphs.append(
            f"An effect of your own may explain it. {FILE} beside this page is a file to start "
            "from; named in the study as effects_file, it is tested beside the catalogue by "
            "vcal loop --trust."
        )
    paragraphs.append(
        "A known cause that is not in the catalogue can be tested: write it as an effect in a file "
        "of your own and name that file in the study."
    )
    shares = [f"{c} {text.percent(share)}" for c, share in shares_by_column(what, plan).items()]
    alone = " (share of the residual that each column describes alone)"
    products = [
        f"{column_of(a, plan)[0]} × {column_of(b, plan)[0]} {text.percent(share)}"
        for a, b, share in what.products
    ]
    where = [
        f"{column} from {text.number(low, 4)} to {text.number(high, 4)}"
        for column, low, high in intervals_in_file(what, closure.after)
    ]
    variance = ", ".join(f"{name} {text.percent(s)}" for name, s in closure.variance.items())
    size = f" ({what.size_is})" if what.size_is else ""
    share = f" ({what.share_is})" if what.share_is else ""
    rows = [
        ("depends on", ", ".join(shares) + alone if shares else "no single recorded column"),
        ("on products of two", ", ".join(products)),
        ("where", "; ".join(where)),
        ("direction at the tool point", what.direction),
        ("size", f"{text.number(what.size_um)} µm{size}"),
        ("share", f"{text.percent(what.share_of_variance)}{share}"),
        ("variance that the declared model leaves", variance),
        ("corrected p-value", text.probability(what.p_value)),
    ]
    note = f"What the empirical description predicts {_IN_UNCERTAINTY}"
    return [
        Section(
            "Unexplained residual",
            tuple(paragraphs),
            tables=(Table(("", ""), [row for row in rows if row[1]]),),
            pictures=shown.get("unexplained", ()),
            note=note if what.empirical is not None else "",
        )
    ]
