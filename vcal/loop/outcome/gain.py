"""Whether compensation reduces the error, in words where it does not."""

import math
from collections.abc import Mapping
from typing import Any

from ..weighing.cross_validation import Rms
from .closure import Errors

_SURELY = 2.0
"""Standard uncertainties by which held-out errors must be larger to count beside check points."""


def no_gain(errors: Mapping[Any, Errors], heldout: Rms | None) -> str:
    """Sentence where the error after closing the loop is not smaller than that of the uncompensated
    machine beyond its uncertainty, or is larger than that of the declared model; else empty.

    Independent check points decide where there are any, and held-out readings otherwise: `heldout`
    is the relative fall of their mean square (`heldout_fall`). Held-out readings that are clearly
    predicted worse than by the uncompensated machine count in any case.
    """
    bare, before, after = (errors[name] for name in ("uncompensated", "before", "after"))
    if (
        bare.check is not None
        and before.check is not None
        and after.check is not None
        and bare.check.value > 0.0
    ):
        where = "at the check points"
        if bare.check.value - after.check.value <= math.hypot(bare.check.u, after.check.u):
            return _said(where, after.check, bare.check, "uncompensated")
        if after.check.value - before.check.value > math.hypot(before.check.u, after.check.u):
            return _said(where, after.check, before.check, "with the declared model alone")
        if heldout is None or heldout.value > -_SURELY * heldout.u:
            return ""
    if heldout is None:
        return ""
    where = "of the held-out readings"
    if heldout.value <= heldout.u:
        return _said(where, after.heldout, bare.heldout, "uncompensated")
    if after.heldout.value - before.heldout.value > math.hypot(before.heldout.u, after.heldout.u):
        return _said(where, after.heldout, before.heldout, "with the declared model alone")
    return ""


def _said(where: str, after: Rms, other: Rms, which: str) -> str:
    larger = "larger" if after.value > other.value else "not significantly smaller"
    return (
        f"Compensation does not reduce the error: {where} it is {_um(after)} after closing the "
        f"loop, {larger} than {_um(other)} {which}."
    )


def _um(it: Rms) -> str:
    return f"{it.value:.3g} ± {float(f'{it.u:.1g}'):g} µm"
