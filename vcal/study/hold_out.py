"""The hold-out of a study: that of its instrument, another one, or that of ``[holdout]``."""

from collections.abc import Callable, Mapping
from dataclasses import replace

import numpy as np

from ..identification.predictable import Unpredictable, unpredictable_by
from ..instruments.conditions import inside_name
from ..machine.plan import Plan, of_set
from ..model.forward import Model
from ..model.measurement import HoldOut, Measurement
from .messages import listed, refusal
from .settings import HoldoutSettings

_FOLDS = 5
_SAME = 0.01
"""Share of the range of a column within which two numbers count as one value."""
_MOST = 0.5
"""Most values of a column, as a share of the rows."""


def held_out(
    settings: HoldoutSettings | None,
    model: Model,
    measurement: Measurement,
    file: str,
    headers: Mapping[str, tuple[str, ...]],
) -> HoldOut | None:
    """The hold-out of a measurement; None for the choice of the instrument.

    Where the instrument keeps rows out of every fit that the others do not predict, a random choice
    of as many rows, or blocks in time, are held out instead if these are predicted. `headers` are
    the columns of the table of every data set. Raises `StudyError` for a column that does not
    exist, or has too few or too many values.
    """
    plan = measurement.plan
    folds, apart = model.instrument.folds(plan)
    apart = np.broadcast_to(apart, folds.shape) & (folds >= 0)
    if settings is not None:
        chosen = _chosen(settings, plan, folds, apart, file, headers)
        why = unpredictable_by(model, measurement, chosen.folds, chosen.apart)
        return chosen if why is None else replace(chosen, unpredicted=_mask(why, plan))
    if not apart.any():
        return None
    why = unpredictable_by(model, measurement, folds, apart)
    if why is None:
        return None
    share = round(float(apart.mean()), 2)
    for other in (_random(plan, share, 0, True), _blocks(plan, _FOLDS)):
        if unpredictable_by(model, measurement, other.folds, other.apart) is None:
            return replace(other, caution=_caution(why, plan, other.words))
    return HoldOut(folds, apart, "the choice of the instrument", unpredicted=_mask(why, plan))


def _mask(why: Unpredictable, plan: Plan) -> np.ndarray:
    found = np.zeros(plan.rows, bool)
    found[why.rows] = True
    return found


def _caution(why: Unpredictable, plan: Plan, instead: str) -> str:
    return (
        f"in the order of time, {why.words(plan)}; {instead} of the rows are held out instead; "
        "measure poses of every kind early too, or choose a hold-out in [holdout]"
    )


def _chosen(
    settings: HoldoutSettings,
    plan: Plan,
    folds: np.ndarray,
    apart: np.ndarray,
    file: str,
    headers: Mapping[str, tuple[str, ...]],
) -> HoldOut:
    keeps = bool(apart.any())
    match settings.kind:
        case "last":
            rank, sizes = _rank_in_time(plan)
            last = rank >= sizes - np.maximum((sizes * settings.share).astype(int), 1)
            return HoldOut(
                np.where(last, 0, -1), last & keeps, f"the last {100 * settings.share:.3g} %"
            )
        case "random":
            return _random(plan, settings.share, settings.seed, keeps)
        case "blocks":
            return _blocks(plan, settings.blocks)
        case "none":
            if "blocks" not in settings.model_fields_set and not keeps:
                return HoldOut(folds, apart, "none")
            return _blocks(plan, settings.blocks)
        case _:
            column = settings.column or "run"
            return _values(column, plan, file, headers)


def _rank_in_time(plan: Plan) -> tuple[np.ndarray, np.ndarray]:
    """Position (n,) of every row in the order of time within its data set, and the number (n,) of
    rows of that data set.
    """
    rank, sizes = np.zeros(plan.rows, int), np.zeros(plan.rows, int)
    for name, inside in plan.parts.items():
        rows = np.flatnonzero(inside)
        clock = next((c for c in ("t", "pose") if plan.has(of_set(name, c) if name else c)), None)
        if clock is not None:
            time = plan.values(of_set(name, clock) if name else clock)[rows]
            rows = rows[np.argsort(time, kind="stable")]
        rank[rows], sizes[rows] = np.arange(len(rows)), len(rows)
    return rank, sizes


def _units(plan: Plan) -> np.ndarray:
    """Number (n,) of what is held out together: a pose of an artefact, else a row."""
    unit = np.arange(plan.rows)
    for name, inside in plan.parts.items():
        key = of_set(name, "pose") if name else "pose"
        if plan.has(key):
            pose = np.asarray(plan.values(key)[inside], int)
            _, first, same = np.unique(pose, return_index=True, return_inverse=True)
            unit[inside] = np.flatnonzero(inside)[first[same.ravel()]]
    return unit


def _random(plan: Plan, share: float, seed: int, keeps: bool) -> HoldOut:
    """A random share of the rows that is never fitted, or as many folds as it takes to predict all
    of them in turn.
    """
    units, place = np.unique(_units(plan), return_inverse=True)
    order = np.random.default_rng(seed).permutation(len(units))
    if keeps:
        held = np.isin(place.ravel(), order[: max(int(share * len(units)), 1)])
        return HoldOut(np.where(held, 0, -1), held, f"a random {100 * share:.3g} %")
    count = min(max(round(1.0 / share), 2), len(units))
    fold = np.empty(len(units), int)
    fold[order] = np.arange(len(units)) % count
    return HoldOut(fold[place.ravel()], np.zeros(plan.rows, bool), f"random {count}ths in turn")


def _blocks(plan: Plan, count: int) -> HoldOut:
    """Blocks in time, each predicted from the others; a pose of an artefact is not divided."""
    rank, sizes = _rank_in_time(plan)
    fold = rank * count // sizes
    first = np.unique(_units(plan), return_inverse=True)[1].ravel()
    lowest = np.full(first.max() + 1, count)
    np.minimum.at(lowest, first, fold)
    return HoldOut(lowest[first], np.zeros(plan.rows, bool), f"{count} blocks in time in turn")


def _values(column: str, plan: Plan, file: str, headers: Mapping[str, tuple[str, ...]]) -> HoldOut:
    """All rows with one value of a column, predicted from those with the others."""
    name = inside_name(column, plan.axes)
    name = {"run": "run"}.get(column, name.removeprefix("commanded_"))
    folds, start = np.zeros(plan.rows, int), 0
    refuse: Callable[[str, str], Exception] = lambda found, expected: refusal(  # noqa: E731
        file, "key holdout.column", found, expected, "name another column, or change the kind"
    )
    for one, inside in plan.parts.items():
        key = of_set(one, name) if one else name
        if not plan.has(key):
            where = f" in the data set {one}" if one else ""
            known = listed(headers.get(one, ()), 60)
            raise refuse(f"the unknown column {column!r}{where}", f"one of {known}")
        values = plan.values(key)[inside]
        order = np.argsort(values, kind="stable")
        apart = np.diff(values[order]) > _SAME * np.ptp(values)
        index = np.empty(len(values), int)
        index[order] = np.r_[0, np.cumsum(apart)]
        count = int(index.max()) + 1
        if not 2 <= count <= max(_MOST * len(values), 2):
            raise refuse(
                f"{count} values in {len(values)} rows of the column {column!r}",
                "from 2 values to one for every two rows",
            )
        folds[inside] = index + start
        start += count
    return HoldOut(folds, np.zeros(plan.rows, bool), f"one value of {column} in turn")
