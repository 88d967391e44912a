"""Section and record of the smallest effects that the measurement would have named."""

import math
from collections.abc import Mapping, Sequence
from typing import Any

from ...effects.base import Effect
from ...effects.data_set import OfDataSet
from ...loop.detectable import PROBABILITY, Detectable, SmallestSize, detectable
from ...loop.outcome.closure import Closure
from ...loop.screening.spanned import Spanned
from ...study.study import Study
from ..html import text
from ..html.sheet import Section, Table


def could_be_seen(closure: Closure, study: Study) -> Detectable | None:
    """The smallest sizes of the effects that were searched for, beside the identified model; None
    where the search had not begun or was interrupted.
    """
    if closure.interrupted or not closure.screenings:
        return None
    asked = closure.settings.get("effects", ())
    classes = [study.catalogue[name] for name in asked if name in study.catalogue]
    alpha, seed = closure.settings["alpha"], closure.settings["seed"]
    return detectable(closure.after, classes, closure.screenings[-1], alpha=alpha, seed=seed)


def could_be_seen_section(seen: Detectable | None) -> list[Section]:
    """The smallest size of every effect that is named, or what is named with it."""
    if seen is None or not (seen.limits or seen.spanned):
        return []
    effects: dict[str, list[SmallestSize]] = {}
    for limit in seen.limits:
        effects.setdefault(limit.effect.key, []).append(limit)
    chance = text.percent(PROBABILITY)
    return [
        Section(
            "What could have been seen",
            (
                f"An effect of these sizes would have been named with a probability of {chance}, "
                "beside what was identified. This measurement says nothing about smaller ones. A "
                "size holds for one amplitude alone, and at the stated pitch, time constant or "
                "point of time: that of median sensitivity.",
            ),
            tables=(
                Table(
                    ("effect", "description", "smallest sizes that are named", "expected size"),
                    [
                        *(_row(key, limits) for key, limits in effects.items()),
                        *map(_spanned_row, seen.spanned),
                    ],
                    "llll",
                    fold="Every effect with the smallest size that would have been named",
                ),
            ),
            minor=True,
        )
    ]


def _spanned_row(one: Spanned) -> tuple[str, str, str, str]:
    told = f"{', '.join(p.name for p in one.effect.amplitudes)}: cannot be seen, {why(one)}"
    return one.effect.key, _inner(one.effect).summary, told, ""


def why(one: Spanned) -> str:
    """Why an effect cannot be seen: ``"taken up by geometric and station"``."""
    if not one.by:
        return "no reading responds"
    return f"taken up by {' and '.join(sorted(one.by))}"


def _inner(effect: Effect) -> Effect:
    return effect.effect if isinstance(effect, OfDataSet) else effect


def _row(key: str, limits: Sequence[SmallestSize]) -> tuple[str, str, str, str]:
    inner = _inner(limits[0].effect)
    sizes: dict[str, list[str]] = {}
    expected: dict[str, None] = {}
    alike: dict[str, None] = {}
    for limit in _smallest(limits).values():
        p = limit.amplitude
        unit = text.unit(p.unit)
        if math.isfinite(limit.size):
            sizes.setdefault(unit, []).append(f"{p.name} {text.number(limit.size, 2)}")
        else:
            sizes.setdefault("not by itself", []).append(p.name)
            alike |= dict.fromkeys(limit.rivals[:2])
        if p.informed:
            expected[f"{text.number(p.sigma, 2)} {unit}"] = None
    told = [
        f"{', '.join(names)} {unit}" if unit != "not by itself"
        else f"{', '.join(names)}: not by itself, as {' or '.join(alike)} may be the cause"
        for unit, names in sizes.items()
    ]  # fmt: skip
    if sizes.keys() - {"not by itself"} and (at := _at(limits[0])):
        told.append(f"for {at}")
    return key, inner.summary, "; ".join(told), ", ".join(expected)


def _at(limit: SmallestSize) -> str:
    """The shape at which a limit holds: ``"pitch = 36 mm"``."""
    return ", ".join(
        f"{p.name} = {text.number(limit.shape[p.name] / p.si, 2)} {text.unit(p.unit)}".strip()
        for p in limit.effect.shapes
        if p.name in limit.shape
    )


def _smallest(limits: Sequence[SmallestSize]) -> Mapping[str, SmallestSize]:
    """The smallest limit of every amplitude, which several instances of an effect may have."""
    found: dict[str, SmallestSize] = {}
    for limit in limits:
        known = found.get(limit.amplitude.name)
        if known is None or limit.size < known.size:
            found[limit.amplitude.name] = limit
    return found


def could_be_seen_record(seen: Detectable | None) -> dict[str, Any]:
    """The keys ``smallest_sizes`` and ``cannot_be_seen`` of the record; empty where the search was
    interrupted.
    """
    if seen is None:
        return {}
    return {
        "smallest_sizes": [
            {
                "effect": limit.effect.name,
                "placement": limit.effect.placement,
                "parameter": limit.amplitude.name,
                "shape": dict(limit.shape),
                "unit": limit.amplitude.unit,
                "size": limit.size if math.isfinite(limit.size) else None,
                "rivals": list(limit.rivals),
            }
            for limit in seen.limits
        ],
        "cannot_be_seen": [
            {"effect": one.effect.name, "placement": one.effect.placement, "by": list(one.by)}
            for one in seen.spanned
        ],
    }
