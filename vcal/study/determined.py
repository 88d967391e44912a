"""Whether the readings of a study determine the parameters of its model."""

import numpy as np

from ..identification.rank import flat_rank
from ..machine.plan import Plan
from ..model.forward import Model
from ..model.measurement import Measurement
from ..words import counted
from .messages import FEW, listed, refusal


def check_size(model: Model, plan: Plan, data: str, measured: bool) -> None:
    """Raise `StudyError` for fewer readings than parameters without a prior.

    Measured readings must exceed these parameters even without any one row, as only the surplus
    determines the scatter.
    """
    flat = [entry for entry in model.entries if not entry.parameter.informed]
    width = len(model.instrument.readings)
    readings = int(model.instrument.present(plan).sum())
    needed = len(flat) + width + 1 if measured and flat else len(flat)
    if readings >= needed:
        return
    keys = listed(dict.fromkeys(entry.key for entry in flat), FEW)
    raise refusal(
        data,
        f"row {plan.row_name(plan.rows - 1)} (the last one)",
        f"{counted(readings, 'reading')} ({counted(plan.rows, 'row')} of {width}) for "
        f"{counted(len(flat), 'parameter')} without a "
        f"prior ({keys})",
        f"more than {needed - 1} readings, so that they outnumber the parameters even without any "
        "one row"
        if measured
        else f"at least {counted(needed, 'reading')}",
        "measure more rows, or give a prior (a *_sigma) to parameters that are known",
    )


def check_determined(model: Model, plan: Plan, data: str) -> None:
    """Raise `StudyError` where the Jacobian of the parameters without a prior has no full rank.

    The number of readings does not help: points on one straight line contain no information about a
    rotation about it.
    """
    found = flat_rank(model, plan)
    if found.rank == found.columns:
        return
    mixed = [model.entries[i] for i in found.mixed]
    names = [f"{entry.key} {entry.parameter.name}" for entry in mixed]
    raise refusal(
        data,
        "columns of positions and conditions",
        f"{plan.rows} rows that identify {found.rank} of {found.columns} parameters without a "
        f"prior; {listed(names, FEW)} {'is' if len(names) == 1 else 'are'} not identified",
        "rows that identify all of them: for an instrument with an unknown pose, positions that "
        "are not all on one straight line or in one place",
        "measure further positions, or give a prior (a *_sigma) to a parameter that can have one",
    )


def check_fitted(model: Model, measurement: Measurement, data: str, chosen: bool) -> None:
    """Raise `StudyError` where the rows that are fitted, without those that are held out of every
    fit, do not determine the parameters without a prior.
    """
    plan, holdout = measurement.plan, measurement.holdout
    if holdout is None:
        folds, apart = model.instrument.folds(plan)
        apart = np.broadcast_to(apart, folds.shape) & (folds >= 0)
    else:
        apart = holdout.apart
    if not apart.any():
        return
    found = flat_rank(model, plan, ~apart)
    if found.rank == found.columns:
        return
    names = [f"{model.entries[i].key} {model.entries[i].parameter.name}" for i in found.mixed]
    raise refusal(
        data,
        "columns of positions and conditions",
        f"{int((~apart).sum())} rows that are fitted, without {int(apart.sum())} held-out ones, "
        f"which identify {found.rank} of {found.columns} parameters without a prior; "
        f"{listed(names, FEW)} {'is' if len(names) == 1 else 'are'} not identified",
        "fitted rows that identify all of them",
        "choose another kind in [holdout], such as random"
        if chosen
        else "measure further positions, or choose the held-out rows in [holdout]",
    )
