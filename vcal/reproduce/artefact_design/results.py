"""The whole of a reproduction as numbers."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

import jax
import jax.numpy as jnp
import numpy as np

from ...design import ArrayPoses
from ...effects.geometric import GeometricErrors
from ...model.prior import Amplitudes
from ...uncertainty.programs import Programs
from .expected import Plain, Task, bayes_um, plain_least_squares, task
from .influences import Cost, costs
from .influences import exact as with_influences
from .machines import Machines, calibrate
from .searches import FREEDOMS, STARTS, STEPS, Optimised, Robust, Searches, optimise, robust
from .setting import KNOWN, NOMINAL, POSES, TRAVEL, Known, ball_line, placed
from .stylus import Star, star
from .sweep import Drawn, Theory, Varied, drawn, exact, theory
from .timing import SHAPES, Chooser, Trade, trade

MACHINES = 1000
SHOWN = 8
"""Machines whose EXX is shown."""
PLACES = 121
LEAST = 100
"""Machines of the smallest campaign."""
_SHORT: tuple[int, tuple[int, ...]] = (9, (6,))
"""Balls and poses of a design that leaves more to the prior."""
Key = tuple[Varied, float]


@dataclass(frozen=True)
class Effort:
    """How much is computed; the whole unless said otherwise."""

    drawn: Mapping[Known, Sequence[Key] | None] = field(
        default_factory=lambda: {"P": (("N", 5), ("N", 11), ("N", 17))}
    )
    """Designs whose machines are drawn; of P few, as every pose has an artefact of its own."""
    searched: tuple[str, ...] = (
        "poses",
        "poses, balls within 60 mm",
        "poses, artefact within 250 mm",
    )
    starts: int = STARTS
    steps: int = STEPS
    shapes: Mapping[int, Sequence[int]] = field(default_factory=lambda: SHAPES)
    """Numbers of poses by number of balls, for error against time."""


@dataclass(frozen=True)
class Searched:
    """A design found by search, judged on machines that the search did not use."""

    optimised: Optimised
    checked: Drawn
    """Fresh machines, exact kinematics."""

    @property
    def off(self) -> float:
        """How far theory is from them, relative."""
        return self.optimised.rms_um / self.checked.rms - 1.0


@dataclass(frozen=True)
class Results:
    """Everything that was computed."""

    seed: int
    draws: int
    fresh: int
    """Machines that judge a design that was searched for."""
    functions: np.ndarray
    """EXX of some machines, um, at equal distances along X."""
    before_um: tuple[float, float]
    """Expected rms of the uncompensated machine, aligned and raw."""
    sets: dict[str, dict[Known, float]]
    """Expected rms by set of poses, at the nominal artefact."""
    plain: dict[Known, list[Plain]]
    """Plain least squares of every order, at the nominal design."""
    theory: dict[Known, dict[Key, Theory]]
    exact: dict[Known, dict[Key, Drawn]]
    costs: dict[Known, dict[str, Cost]]
    influenced: dict[str, Drawn]
    """All influences in the truth, artefact S: ignored and identified."""
    searched: dict[Known, dict[str, Searched]]
    nominal: dict[Known, Drawn]
    """The nominal design on the same fresh machines."""
    star: dict[Known, Star]
    trade: dict[Known, Trade]
    robust: dict[str, Robust]
    """Designs for several families, by poses and balls."""


def nominal_poses() -> ArrayPoses:
    """The publication's artefact in the strongest of the twelve poses."""
    return placed(POSES[next(iter(POSES))](), ball_line(*NOMINAL))


def compute(
    draws: int, seed: int, progress: Callable[[str], None], effort: Effort | None = None
) -> Results:
    """Everything; campaigns have `draws` machines, those that judge a search twice as many."""
    effort = effort or Effort()
    given, usual, programs = task(), nominal_poses(), Programs()
    before = tuple(1e6 * float(np.trace(g)) ** 0.5 for g in given.gram)
    progress("poses")
    sets = _sets(given)
    expected: dict[Known, dict[Key, Theory]] = {}
    plain: dict[Known, list[Plain]] = {}
    for known in KNOWN:
        progress(f"21 designs by theory, {known}")
        expected[known] = theory(given, known)
        plain[known] = plain_least_squares(given, usual, known)
    machines: dict[Known, dict[Key, Drawn]] = {}
    for known in KNOWN:
        machines[known] = exact(
            given,
            known,
            draws=draws,
            seed=seed,
            programs=programs,
            progress=progress,
            only=effort.drawn.get(known),
        )
    progress("influences")
    cost: dict[Known, dict[str, Cost]] = {known: costs(given, usual, known) for known in KNOWN}
    influenced: dict[str, Drawn] = {}
    for name, identified in (("ignored", False), ("identified", True)):
        progress(f"machines with all influences, {name}")
        made = with_influences(given, usual, "S", identified=identified, draws=draws, seed=seed)
        influenced[name] = drawn(made)
    fresh = 2 * draws

    def checked(poses: ArrayPoses, known: Known) -> Drawn:
        made: Machines = calibrate(
            given, poses, known, draws=fresh, seed=seed + 1, programs=programs
        )
        return drawn(made)

    searched = _searched(given, effort, seed, progress, checked)
    judged: dict[Known, Drawn] = {known: checked(usual, known) for known in KNOWN}
    stars: dict[Known, Star] = {}
    for known in KNOWN:
        progress(f"star stylus, {known}")
        stars[known] = star(given, usual, known, steps=effort.steps, seed=seed)
    traded = trade(given, shapes=effort.shapes, seed=seed, progress=progress)
    return Results(
        seed=seed,
        draws=draws,
        fresh=fresh,
        functions=_functions(given, seed),
        before_um=(before[0], before[1]),
        sets=sets,
        plain=plain,
        theory=expected,
        exact=machines,
        costs=cost,
        influenced=influenced,
        searched=searched,
        nominal=judged,
        star=stars,
        trade=traded,
        robust=_robust(given, effort, seed, progress),
    )


def _sets(given: Task) -> dict[str, dict[Known, float]]:
    """Expected rms of the nominal artefact by set of poses."""
    balls = ball_line(*NOMINAL)
    return {
        name: {known: bayes_um(given, placed(make(), balls), known)[0] for known in KNOWN}
        for name, make in POSES.items()
    }


def _searched(
    given: Task,
    effort: Effort,
    seed: int,
    progress: Callable[[str], None],
    checked: Callable[[ArrayPoses, Known], Drawn],
) -> dict[Known, dict[str, Searched]]:
    """Designs that searches find from the nominal one, judged by `checked`."""
    found: dict[Known, dict[str, Searched]] = {known: {} for known in KNOWN}
    for name in effort.searched:
        searches = Searches([given], FREEDOMS[name])
        for known in KNOWN:
            progress(f"search, {known}: {name}")
            best = optimise(
                given,
                nominal_poses(),
                known,
                FREEDOMS[name],
                starts=effort.starts,
                steps=effort.steps,
                seed=seed,
                searches=searches,
            )
            found[known][name] = Searched(best, checked(best.poses, known))
    return found


def _robust(
    given: Task, effort: Effort, seed: int, progress: Callable[[str], None]
) -> dict[str, Robust]:
    few = Chooser(given, seed=seed).choose(*_SHORT, "S")[0].poses
    return {
        f"{start.rotation.shape[0]} poses of {start.balls.shape[0]} balls": robust(
            "S", nominal=start, steps=min(effort.steps, 200), seed=seed, progress=progress
        )
        for start in (nominal_poses(), few)
    }


def _functions(given: Task, seed: int) -> np.ndarray:
    """EXX of some machines at `PLACES` along X, um."""
    geometric = given.model.effects[0]
    assert isinstance(geometric, GeometricErrors)
    names = [p.name for p in geometric.amplitudes]
    motion = next(m for m in geometric.motions if m.name == "EXX")
    own = [names.index(f"EXX.{label}") for label in motion.basis.labels]
    values = np.asarray(motion.basis.functions(jnp.linspace(*TRAVEL["X"], PLACES)))
    steps = np.array([geometric.amplitudes[i].step for i in own])
    amplitudes = Amplitudes.of(given.model.effects)
    keys = jax.random.split(jax.random.key(seed), SHOWN)
    drawn = np.stack([np.asarray(amplitudes.sample(key))[own] for key in keys])
    return 1e6 * (drawn * steps) @ values.T
