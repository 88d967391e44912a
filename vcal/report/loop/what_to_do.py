"""Section and record of what the effects do at the tool point, and what to do about them."""

from collections.abc import Sequence
from typing import Any

from ...effects.base import Effect
from ...effects.data_set import OfDataSet
from ...geometry.effect_displacements import Reach, reach
from ...loop.outcome.closure import Closure, FoundEffect
from ..html import text
from ..html.sheet import Section, Table

_UM = 1e6


def reaches(closure: Closure) -> dict[str, Reach]:
    """How far every effect that was found moves the tool point, by its key."""
    fit = closure.after
    found = {}
    for one in closure.effects:
        place = next(i for i, e in enumerate(fit.model.effects) if e.alike(one.effect))
        found[one.effect.key] = reach(fit, place)
    return found


def what_to_do(closure: Closure, moved: dict[str, Reach]) -> list[Section]:
    """The effects that were found, the one that moves the tool point most first, with its size at
    the tool point and a remedy; no section where nothing was found.
    """
    listed = sorted(closure.found, key=lambda one: -moved[one.effect.key].largest)
    if not listed:
        return []
    rows = [_row(one, moved[one.effect.key]) for one in listed]
    first = listed[0]
    size = moved[first.effect.key].largest
    inner = _inner(first)
    lead = (
        f"{text.sentence_of(inner.summary)[:-1]}{_amount(first)}: {first.name} moves the tool "
        f"point by up to {text.number(_UM * size)} µm."
        if size > 0.0
        else "What was found belongs to the instrument; it does not move the tool point."
    )
    header = ("effect", "description", "largest, µm", "rms, µm")
    note = (
        "Distance at the tool point from its mean over the measurement, at the conditions of its "
        "rows. An effect of the instrument does not move the tool point."
    )
    table = Table(header, rows, "llrr", note=note)
    return [Section("What to do", (lead,), points=tuple(_remedies(listed)), tables=(table,))]


def _amount(one: FoundEffect) -> str:
    """Size of an effect with one parameter; its sign is in the table of the effect."""
    if len(one.parameters) != 1:
        return ""
    ((_, value, unit, _),) = one.parameters
    return f", {text.number(abs(value))} {text.unit(unit)}"


def _row(one: FoundEffect, moved: Reach) -> tuple[str, ...]:
    inner = _inner(one)
    sizes = [text.number(_UM * v) if moved.largest > 0.0 else text.DASH for v in moved]
    return one.name, inner.summary, *sizes


def _remedies(listed: Sequence[FoundEffect]) -> list[str]:
    said = []
    for one in listed:
        remedy = _inner(one).remedy or "Look for its cause on the machine."
        unsure = "" if one.status == "named" else "The name is not certain: decide it first. "
        said.append(f"{one.name}: {unsure}{remedy}")
    return said


def _inner(one: FoundEffect) -> Effect:
    return one.effect.effect if isinstance(one.effect, OfDataSet) else one.effect


def reach_record(moved: Reach | None) -> dict[str, Any]:
    """The key ``at_the_tool_um`` of an effect in the record."""
    if moved is None:
        return {}
    return {"at_the_tool_um": {"largest": _UM * moved.largest, "rms": _UM * moved.rms}}
