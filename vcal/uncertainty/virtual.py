"""The uncertainty that a plan will achieve: a virtual calibration by GUM and Monte Carlo.

Machines are drawn from a truth, measured on the plan, identified and compensated. Monte Carlo and
the GUM are applied to the same identification and compared. The contributions to the remaining
volumetric error come from the GUM, in which they add: with d(s) the root-mean-square displacement
of the tool point from source s,

    rms^2 = sum over s of d(s)^2 + d(known)^2.
"""

import re
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from ..identification.fit import Learnt, entries, null_directions
from ..machine.chain import Chain
from ..machine.parameters import Parameter
from ..machine.plan import Plan
from ..model.forward import Model
from ..model.simulate import scattered, travels
from ..numerics.arrays import Array
from .adaptive import Precision
from .campaign import Campaign, monte_carlo
from .comparison import Comparison, compare
from .ensemble import Ensemble, FieldResult
from .linear import Linearised, linearised_groups
from .outputs import Field, Output
from .quantities import (
    ErrorMotionErrors,
    LineErrors,
    Measure,
    Pair,
    ParameterErrors,
    State,
    VolumetricErrors,
)
from .streaming import Progress

MOST = 1_000_000
"""Largest number of draws of an adaptive virtual calibration."""
_NODES = 7
"""Grid points along an axis for the evaluation of the volumetric error."""
_SCATTERED = 200
"""Number of random positions for machines with axes other than X, Y and Z."""
_MOTIONS = (5, 9)
"""Least and largest number of positions along an axis for the evaluation of error motions."""
_NOTHING = 1e-6
"""Volumetric error, um, below which it is a rounding error."""
_BEFORE, _AFTER = "volumetric error before [um]", "volumetric error after [um]"
_PARTS = "error components after [um]"

Origin = Literal["noise", "fitted", "not fitted"]
Statistic = Literal["mean", "rms", "largest"]
When = Literal["before", "after"]
STATISTICS: tuple[Statistic, ...] = ("mean", "rms", "largest")
"""Statistics of the volumetric error over the points of one machine."""
WHEN: tuple[When, ...] = ("before", "after")
"""Before and after calibration."""


class Contribution(NamedTuple):
    """The contribution of one source to the volumetric error after calibration."""

    source: str
    """Key of an effect, ``"noise of the reading"`` with the name of that reading, or a random
    effect and its parameter.
    """
    origin: Origin
    """Noise, a fitted effect with its posterior uncertainty, or an effect that is not fitted."""
    rms: float
    """Root mean square over points and machines, um."""
    share: float
    """Share of the mean square."""


class Motion(NamedTuple):
    """One error motion along its axis: true minus identified, in um or urad."""

    name: str
    """ISO 230-1 name, such as ``"EXY"``."""
    axis: str
    unit: str
    position: Float[np.ndarray, " n"]
    """m or rad."""
    prior: Float[np.ndarray, " n"]
    """Standard deviation of the true motion, before any measurement."""
    u_gum: Float[np.ndarray, " n"]
    u: Float[np.ndarray, " n"]
    """Standard deviation in the Monte Carlo."""
    mean: Float[np.ndarray, " n"]
    low: Float[np.ndarray, " n"]
    high: Float[np.ndarray, " n"]


class Scalar(NamedTuple):
    """A scalar output of the Monte Carlo, um."""

    mean: float
    u: float
    low: float
    high: float


@dataclass(frozen=True)
class VirtualCalibration:
    """The results of a virtual calibration of a plan."""

    campaign: Campaign = field(repr=False)
    parameters: Comparison = field(repr=False)
    """Identified minus true value of every fitted amplitude: GUM against Monte Carlo."""
    entries: tuple[tuple[str, Parameter], ...] = field(repr=False)
    """(effect with placement, parameter) for every line of `parameters`."""
    motions: tuple[Motion, ...] = field(repr=False)
    motion_comparison: Comparison = field(repr=False)
    lines: Comparison = field(repr=False)
    """Squareness errors and slopes of positioning errors (`LineErrors`); empty for an arm."""
    lines_before: Float[np.ndarray, " n"] = field(repr=False)
    """Standard deviations of `lines` before any measurement."""
    contributions: tuple[Contribution, ...]
    """Largest first."""
    known: float
    """Rms displacement by known effects of the truth that are not fitted, um; it is not random."""
    points: Plan = field(repr=False)
    """Points at which the volumetric error is evaluated."""
    nodes: tuple[np.ndarray, ...]
    """Grid along X, Y and Z (m), whose product in this order gives the points; empty for random
    points.
    """
    directions: int
    """Number of directions in the space of the parameters with a prior."""
    determined: int
    """Number of these that the plan determines to better than half their prior variance."""
    unseen: tuple[str, ...]
    """Combinations of parameters about which the plan contains almost no information, in words."""
    hardly: tuple[str, ...]
    """Parameters about which the plan contains hardly any information."""
    coverage: float

    @property
    def ensemble(self) -> Ensemble:
        """All results of the Monte Carlo."""
        return self.campaign.ensemble

    @property
    def rms_gum(self) -> float:
        """Root mean square of the volumetric error over points and machines by the GUM, um."""
        return float(np.hypot(np.sqrt(sum(c.rms**2 for c in self.contributions)), self.known))

    @property
    def rms_monte_carlo(self) -> float:
        """Root mean square of the volumetric error over points and machines by Monte Carlo, um."""
        found = self.volumetric("rms", "after")
        return float(np.hypot(found.mean, found.u))

    @property
    def faultless(self) -> bool:
        """Whether no machine has an error before calibration, as none is declared."""
        return max(self.volumetric("largest", "before")) < _NOTHING

    @property
    def improved(self) -> float:
        """Share of the machines whose rms volumetric error decreased."""
        at = [self.ensemble.index(_label("rms", when)) for when in WHEN]
        before, after = self.ensemble.values[:, at].T
        good = np.isfinite(before) & np.isfinite(after)
        return float(np.mean(after[good] < before[good])) if good.any() else float("nan")

    def volumetric(self, statistic: Statistic, when: When) -> Scalar:
        """A statistic of the volumetric error over the points, um, with its coverage interval."""
        label = _label(statistic, when)
        i = self.ensemble.index(label)
        low, high = self.ensemble.interval(label, self.coverage)
        return Scalar(float(self.ensemble.mean[i]), float(self.ensemble.u[i]), low, high)

    def bounds(self, when: When) -> Float[np.ndarray, " n"]:
        """Volumetric error per point, um, that a machine exceeds with probability 1 - coverage."""
        return self._field(when).quantiles[self.coverage]

    def _field(self, when: When) -> FieldResult:
        return self.ensemble.fields[_BEFORE if when == "before" else _AFTER]


def virtual_calibration(
    truth: Model,
    fit: Model,
    plan: Plan,
    *,
    draws: int | Literal["adaptive"] = 20_000,
    seed: int = 0,
    noise_factor: float = 1.0,
    coverage: float = 0.95,
    digits: Literal[1, 2] = 1,
    most: int = MOST,
    chunk: int | None = None,
    folder: Path | str | None = None,
    progress: Progress = lambda done, total: None,
    step: Callable[[str], None] = lambda text: None,
    client: Any = None,
) -> VirtualCalibration:
    """The uncertainty of a plan before measuring, with machines from `truth` and the model `fit`.

    The volumetric error is evaluated after rigid alignment on a grid over the travel, or at random
    positions for machines with axes other than X, Y and Z. Each point has the conditions of a
    random row of the plan and a random direction of approach. The validation by clause 8 of JCGM
    101 uses `digits` significant digits of u. It needs two sub-blocks of 10 000 draws; with fewer,
    every verdict is undecided.

    `step` is called with the name of every step. The other arguments and the errors raised are
    those of `monte_carlo`; `ValueError` is also raised for a truth with two effects of one key.
    """
    check_keys(truth)
    points, nodes = judged_points(truth.chain, plan)
    motions = ErrorMotionErrors(int(np.clip(200 // (6 * len(truth.chain.axes)), *_MOTIONS)))
    volumetric = VolumetricErrors(points, quantiles=(coverage,))
    straight = () if truth.chain.arm else (LineErrors(),)
    step("drawing machines")
    campaign = monte_carlo(
        truth,
        fit,
        plan,
        draws=draws,
        seed=seed,
        quantities=(ParameterErrors(), motions, *straight, volumetric),
        noise_factor=noise_factor,
        coverage=coverage,
        digits=digits,
        most=most,
        chunk=chunk,
        folder=folder,
        progress=progress,
        client=client,
    )
    step("propagating uncertainty (GUM)")
    pair = campaign.pair
    along = [quantity.measure(pair) for quantity in (motions, *straight)]
    after = [ParameterErrors().measure(pair), *along]
    before = [_Uncompensated(one) for one in along]
    volume = _Parts(volumetric.measure(pair))
    linear, inputs = linearised_groups(pair, (after, (*before, volume)), coverage)
    contributions, known = _contributions(pair, inputs, points.rows)
    learnt, unseen = _learnt(pair)
    compared = compare(linear.budget, campaign.ensemble, digits)
    fitted = len(fit.entries)
    rest = fitted + sum(len(o.labels) for o in along[0].outputs if isinstance(o, Output))
    motion_comparison, lines = (
        _part(compared, part) for part in (slice(fitted, rest), slice(rest, None))
    )
    prior = dict(zip(inputs.budget.labels, inputs.budget.u, strict=True))
    return VirtualCalibration(
        campaign=campaign,
        parameters=_part(compared, slice(fitted)),
        entries=tuple((e.key, e.parameter) for e in fit.entries),
        motions=_motions(truth.chain, plan, motions.nodes, motion_comparison, inputs),
        motion_comparison=motion_comparison,
        lines=lines,
        lines_before=np.array([prior[label] for label in lines.labels]),
        contributions=contributions,
        known=known,
        points=points,
        nodes=nodes,
        directions=learnt.directions,
        determined=learnt.determined,
        unseen=unseen,
        hardly=learnt.hardly,
        coverage=coverage,
    )


def check_keys(truth: Model) -> None:
    """Raise `ValueError` where two effects of a truth have the same name and placement."""
    keys = [e.key for e in (*truth.effects, *truth.random)]
    twice = [key for key in dict.fromkeys(keys) if keys.count(key) > 1]
    if twice:
        raise ValueError(
            f"the truth: found two effects {twice[0]!r}, expected at most one of a name and "
            "placement; remove the one that is declared already"
        )


def judged_points(chain: Chain, plan: Plan) -> tuple[Plan, tuple[np.ndarray, ...]]:
    """The points for the volumetric error, and their grid along X, Y and Z; empty for random
    points.
    """
    if set(chain.axes) != set("XYZ"):
        return scattered(chain, plan, jax.random.key(0), _SCATTERED), ()
    some = scattered(chain, plan, jax.random.key(0), _NODES**3)
    travel = travels(chain, plan)
    ends = [travel[chain.axes.index(axis)] for axis in "XYZ"]
    nodes = tuple(np.linspace(low, high, _NODES) for low, high in ends)
    mesh = np.stack(np.meshgrid(*nodes, indexing="ij"), -1).reshape(-1, 3)
    position = mesh[:, ["XYZ".index(axis) for axis in chain.axes]]
    return some.elsewhere(position, np.arange(some.rows)), nodes


def _part(comparison: Comparison, rows: slice) -> Comparison:
    """Some of the outputs of a comparison."""
    arrays = ("labels", "value", "u", "low", "high", "delta")
    cut = {name: getattr(comparison, name)[rows] for name in arrays}
    return replace(comparison, **cut, precision=Precision(*(s[rows] for s in comparison.precision)))


def _label(statistic: str, when: str) -> str:
    return f"{statistic} volumetric error {when} [um]"


# --- measures for the GUM only ---


class _Uncompensated(Measure):
    """A measure before calibration, with all identified parameters at zero."""

    inner: Measure

    @property
    def outputs(self) -> tuple[Output | Field, ...]:
        return self.inner.outputs

    def __call__(self, state: State) -> dict[str, Array]:
        return self.inner(state._replace(found=0.0 * state.found))


class _Parts(Measure):
    """Components of the volumetric error after calibration, as scalars."""

    inner: Measure
    size: tuple[int, ...] = eqx.field(static=True)

    def __init__(self, inner: Measure):
        self.inner = inner
        (self.size,) = (o.shape for o in inner.outputs if o.name == _PARTS)

    @property
    def outputs(self) -> tuple[Output | Field, ...]:
        return (Output(_PARTS, self.size),)

    def __call__(self, state: State) -> dict[str, Array]:
        return {_PARTS: jnp.asarray(self.inner(state)[_PARTS])}


def _contributions(
    pair: Pair, inputs: Linearised, points: int
) -> tuple[tuple[Contribution, ...], float]:
    budget = inputs.budget
    rows = [i for i, label in enumerate(budget.labels) if label.startswith(_PARTS)]
    squares = (budget.sensitivity[rows] ** 2).sum(0) / points
    known = float((budget.value[rows] ** 2).sum() / points)
    total = float(squares.sum()) + known
    fitted = {e.key for e in pair.fit.effects}
    scatter = [f"{e.key}: {p.name}" for e in pair.truth.random for p in e.amplitudes]
    found = []
    for name, square in zip(budget.source.labels, squares.tolist(), strict=True):
        source, origin = name, "fitted" if name in fitted else "not fitted"
        if match := re.fullmatch(r"noise: (.+)", name):
            source, origin = f"noise of the reading {match[1]}", "noise"
        elif match := re.fullmatch(r"scatter (\d+)", name):
            source, origin = scatter[int(match[1]) - 1], "noise"
        if square > 0.0:
            found.append(Contribution(source, origin, square**0.5, square / total))
    return tuple(sorted(found, key=lambda c: -c.share)), known**0.5


def _motions(
    chain: Chain, plan: Plan, count: int, comparison: Comparison, inputs: Linearised
) -> tuple[Motion, ...]:
    """The outputs of `ErrorMotionErrors`, ordered by axis and position."""
    prior = dict(zip(inputs.budget.labels, inputs.budget.u, strict=True))
    travel = travels(chain, plan)
    found = []
    for a, axis in enumerate(chain.axes):
        low, high = travel[a]
        position = np.linspace(low, high, count)
        for k, c in enumerate("XYZABC"):
            rows = [6 * (a * count + i) + k for i in range(count)]
            labels = [comparison.labels[i] for i in rows]
            found.append(
                Motion(
                    name=f"E{c}{axis}",
                    axis=axis,
                    unit="um" if c in "XYZ" else "urad",
                    position=position,
                    prior=np.array([prior[label] for label in labels]),
                    u_gum=comparison.u[rows, 0],
                    u=comparison.u[rows, 1],
                    mean=comparison.value[rows, 1],
                    low=comparison.low[rows, 1],
                    high=comparison.high[rows, 1],
                )
            )
    return tuple(found)


class _Known(NamedTuple):
    """The attributes of a fit that `null_directions` uses, for a plan without readings."""

    entries: tuple[tuple[str, Parameter], ...]
    precision: np.ndarray
    jacobian: np.ndarray


def _learnt(pair: Pair) -> tuple[Learnt, tuple[str, ...]]:
    """The part of the parameter space that the plan determines, and the unobserved directions in
    words.
    """
    batch, names = pair.batch, entries(pair.fit)
    root = np.asarray(batch.root_precision)
    found = Learnt.of(names, root, np.asarray(batch.inverse))
    if not found.directions:
        return found, ()
    known = _Known(names, root**2, np.asarray(batch.jacobian))
    return found, tuple(null_directions(known))  # pyright: ignore[reportArgumentType]
