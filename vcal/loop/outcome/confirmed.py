"""Whether recorded accelerometers and inclinometers confirm a tilt that the loop has identified."""

import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.special import fdtrc, stdtrit

from ...instruments.recorded import response_column
from .closure import Closure, FoundEffect

_LEVEL = 0.95


@dataclass(frozen=True)
class Confirmation:
    """A recorded response against the tilt that an identified effect predicts."""

    column: str
    effect: str
    """Name and placement of the effect."""
    coefficient: float
    """Recorded change per predicted change: one where the sensor is on the body that tilts and its
    axis is that of its name."""
    expanded: float
    """Expanded uncertainty of the coefficient (95 %)."""
    across: float
    """Recorded change per change that a sensor turned by 90 degrees about the vertical would read:
    zero where the axis is that of its name."""
    across_expanded: float
    """Its expanded uncertainty (95 %)."""
    share: float
    """Share of the variance of the recorded values that both describe."""
    p_value: float
    """Of that share without any relation."""


def confirmations(closure: Closure) -> list[Confirmation]:
    """Every recorded response against every identified effect that tilts a body.

    The recorded values are fitted by a constant, a drift that is linear in the sequence of the
    rows, and the predicted changes along and across the axis of the sensor. Responses are not used
    to find an effect, so that they are independent of its identification.
    """
    fit = closure.after
    plan, up = fit.measurement.plan, fit.model.chain.up
    found = []
    for effect in closure.effects:
        tilt = _tilt(closure, effect)
        if tilt is None:
            continue
        for name in plan.covariates:
            sensor = response_column(name)
            if sensor is None:
                continue
            values = plan.values(name)
            there = np.isfinite(values)
            turned = np.cross(tilt, np.array(up))
            predicted = np.column_stack([sensor.reading(w, up) for w in (tilt, turned)])
            result = _related(values[there], predicted[there])
            if result is not None:
                key = f"{effect.effect.name} {effect.placement}".strip()
                found.append(Confirmation(name, key, *result))
    return found


def _tilt(closure: Closure, found: FoundEffect) -> Float[np.ndarray, "n 3"] | None:
    """The tilt (n, 3), rad, that an identified effect predicts; None for one without a tilt."""
    unit = found.effect.tilts(closure.after.measurement.plan)
    if not unit:
        return None
    si = {p.name: p.si for p in found.effect.amplitudes}
    sizes = {name: value * si[name] for name, value, *_ in found.parameters if name in unit}
    return np.sum([sizes[name] * np.asarray(unit[name]) for name in sizes], axis=0)


def _related(
    values: Float[np.ndarray, " n"], predicted: Float[np.ndarray, "n 2"]
) -> tuple[float, float, float, float, float, float] | None:
    """Coefficients along and across with their expanded uncertainties, share and p-value; None
    where too few rows or no changes exist.

    Neighbouring rows whose residuals are correlated count for less: with r1 the correlation of
    neighbours, n (1 - r1) / (1 + r1) rows are independent.
    """
    n = len(values)
    if n < 8 or np.ptp(values) == 0.0:
        return None
    sequence = np.linspace(-1.0, 1.0, n)
    null = np.column_stack([np.ones(n), sequence])
    changing = predicted - null @ np.linalg.lstsq(null, predicted, rcond=None)[0]
    kept = np.linalg.norm(changing, axis=0) > 1e-9 * max(np.linalg.norm(predicted), 1e-300)
    if not kept.any():
        return None
    columns = np.column_stack([null, predicted[:, kept]])
    scale = np.linalg.norm(columns, axis=0)
    coefficients, _, rank, _ = np.linalg.lstsq(columns / scale, values, rcond=None)
    if rank < columns.shape[1]:
        return None
    residual = values - columns / scale @ coefficients
    plain = values - null @ np.linalg.lstsq(null, values, rcond=None)[0]
    after, before = float(residual @ residual), float(plain @ plain)
    if before == 0.0:
        return None
    r1 = float(residual[1:] @ residual[:-1]) / after if after > 0.0 else 0.0
    r1 = min(max(r1, 0.0), 0.99)
    used = int(kept.sum())
    dof = max(n * (1.0 - r1) / (1.0 + r1) - columns.shape[1], 1.0)
    share = 1.0 - after / before
    ratio = (share / used) / max((1.0 - share) / dof, 1e-300)
    variance = after / (n - columns.shape[1]) * (1.0 + r1) / (1.0 - r1)
    covariance = np.linalg.inv((columns / scale).T @ (columns / scale)) * variance
    k = float(stdtrit(dof, 0.5 * (1.0 + _LEVEL)))
    own, expanded = np.full(2, math.nan), np.full(2, math.nan)
    own[kept] = (coefficients / scale)[2:]
    expanded[kept] = k * np.sqrt(np.diag(covariance))[2:] / scale[2:]
    return (
        float(own[0]), float(expanded[0]), float(own[1]), float(expanded[1]), share,
        float(fdtrc(used, dof, ratio)),
    )  # fmt: skip
