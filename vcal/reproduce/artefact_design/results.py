"""The whole of a reproduction as numbers."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property

import jax
import jax.numpy as jnp
import numpy as np

from ...design import ArrayPoses
from ...effects.geometric import GeometricErrors
from ...model.prior import Amplitudes
from ...uncertainty.programs import Programs
from ..registry import Computed, Lazy, each, part
from .expected import Plain, Task, bayes_um, plain_least_squares, task
from .influences import Cost, costs
from .influences import exact as with_influences
from .machines import calibrate
from .searches import FREEDOMS, STARTS, STEPS, Polished, Robust, Searches, optimise, robust
from .setting import KNOWN, NOMINAL, POSES, TRAVEL, Known, ball_line, placed
from .stylus import Star, star
from .sweep import Drawn, Theory, Varied, designs, drawn, exact, theory
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

    optimised: Polished
    checked: Drawn
    """Fresh machines, exact kinematics."""

    @property
    def off(self) -> float:
        """How far theory is from them, relative."""
        return self.optimised.rms_um / self.checked.rms - 1.0


def nominal_poses() -> ArrayPoses:
    """The publication's artefact in the strongest of the twelve poses."""
    return placed(POSES[next(iter(POSES))](), ball_line(*NOMINAL))


@dataclass
class Results(Computed):
    """Everything; campaigns have `draws` machines, those that judge a search twice as many."""

    effort: Effort = field(default_factory=Effort)

    @property
    def fresh(self) -> int:
        """Machines that judge a design that was searched for."""
        return 2 * self.draws

    @cached_property
    def task(self) -> Task:
        """The publication's machine."""
        return task()

    @cached_property
    def programs(self) -> Programs:
        """Shared by all campaigns."""
        return Programs(brief=True)

    @property
    def before_um(self) -> tuple[float, float]:
        """Expected rms of the uncompensated machine, aligned and raw."""
        aligned, raw = (1e6 * float(np.trace(g)) ** 0.5 for g in self.task.gram)
        return aligned, raw

    @part("machines that are shown")
    def functions(self) -> np.ndarray:
        """EXX of some machines, um, at equal distances along X."""
        return _functions(self.task, self.seed)

    @each("poses: {}", POSES)
    def sets(self, name: str) -> dict[Known, float]:
        """Expected rms of the nominal artefact by set of poses."""
        poses = placed(POSES[name](), ball_line(*NOMINAL))
        return {known: bayes_um(self.task, poses, known)[0] for known in KNOWN}

    @each("plain least squares, {}", KNOWN)
    def plain(self, known: Known) -> list[Plain]:
        """Of every order, at the nominal design."""
        return plain_least_squares(self.task, nominal_poses(), known)

    @each("21 designs by theory, {}", KNOWN)
    def theory(self, known: Known) -> Mapping[Key, Theory]:
        made = {design.key: design for design in designs()}
        return Lazy(made, lambda key: theory(self.task, made[key], known))

    @each("machines with exact kinematics, {}", KNOWN)
    def exact(self, known: Known) -> dict[Key, Drawn]:
        campaign = {"draws": self.draws, "seed": self.seed, "programs": self.programs}
        only = self.effort.drawn.get(known)
        return exact(self.task, known, **campaign, progress=self.progress, only=only)

    @each("influences, {}", KNOWN)
    def costs(self, known: Known) -> Mapping[str, Cost]:
        return costs(self.task, nominal_poses(), known)

    @each("machines with all influences, {}", ("ignored", "identified"))
    def influenced(self, name: str) -> Drawn:
        """All influences in the truth, artefact S."""
        campaign = {"draws": self.draws, "seed": self.seed}
        identified = name == "identified"
        return drawn(
            with_influences(self.task, nominal_poses(), "S", identified=identified, **campaign)
        )

    @each("searches: {}", FREEDOMS)
    def searches(self, freedom: str) -> Searches:
        return Searches([self.task], FREEDOMS[freedom])

    @each("designs by gradient, {}", KNOWN)
    def searched(self, known: Known) -> Mapping[str, Searched]:
        """Designs that searches find from the nominal one."""

        def search(name: str) -> Searched:
            self.progress(f"search, {known}: {name}")
            start = self.task, nominal_poses(), known, FREEDOMS[name]
            own = {"starts": self.effort.starts, "steps": self.effort.steps, "seed": self.seed}
            best = optimise(*start, **own, searches=self.searches[name])
            return Searched(best, self.checked(best.poses, known))

        return Lazy(self.effort.searched, search)

    def checked(self, poses: ArrayPoses, known: Known) -> Drawn:
        """Fresh machines with exact kinematics, which no search used, with a design."""
        campaign = {"draws": self.fresh, "seed": self.seed + 1, "programs": self.programs}
        return drawn(calibrate(self.task, poses, known, **campaign))

    @each("fresh machines, nominal design, {}", KNOWN)
    def nominal(self, known: Known) -> Drawn:
        return self.checked(nominal_poses(), known)

    @each("star stylus, {}", KNOWN)
    def star(self, known: Known) -> Star:
        return star(self.task, nominal_poses(), known, steps=self.effort.steps, seed=self.seed)

    @part("error against time")
    def trade(self) -> dict[Known, Trade]:
        return trade(self.task, shapes=self.effort.shapes, seed=self.seed, progress=self.progress)

    @part("designs for several families")
    def robust(self) -> dict[str, Robust]:
        """By poses and balls."""
        few = Chooser(self.task, seed=self.seed).choose(*_SHORT, "S")[0].poses
        own = {"steps": min(self.effort.steps, 200), "seed": self.seed, "progress": self.progress}
        return {
            f"{start.rotation.shape[0]} poses of {start.balls.shape[0]} balls": robust(
                "S", nominal=start, **own
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
