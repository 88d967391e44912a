"""A design for machines that are not quite those of Table 1.

A design that is optimal for one declared family may be so by its waves and its sizes. Here the same
poses and balls are judged with other families - larger rotations, other waves - and a design is
searched for the average over them,

    J^2 = 1/f sum over families of tr(G_i C_i),

each family with its own prior, its own grid and an identification that knows it: what is left of a
machine drawn from any of them. What happens where the identification assumes the wrong family is
another matter, and not answered here.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from ...design import ArrayPoses
from .expected import task
from .searches import FREEDOMS, Polished, Searches
from .setting import NOMINAL, POSES, TABLE_ONE, WAVES, Family, Known, ball_line, placed

FAMILIES: Mapping[str, Family] = {
    "Table 1": Family(),
    "rotations x 2, translations / 2": Family(
        {
            name: tuple(v * (2.0 if name[1] in "ABC" else 0.5) for v in row)
            for name, row in TABLE_ONE.items()
        },
        squareness_urad=80.0,
    ),
    "other waves": Family(
        waves={axis: (0.75, 1.5 * second) for axis, (_, second) in WAVES.items()}
    ),
}
"""By name; the first is the publication's."""
FREEDOM = "poses, balls within 60 mm"
NOMINAL_DESIGN, AVERAGE = "nominal", "the average"


@dataclass(frozen=True)
class Robust:
    """Designs against families, for one way to know the artefact."""

    known: Known
    families: tuple[str, ...]
    designs: Mapping[str, ArrayPoses]
    """The nominal one, and one optimised for every family and for their average, by what it is
    optimised for.
    """
    rms_um: Mapping[str, tuple[float, ...]]
    """Expected, aligned, of every design with every family."""

    def average_um(self, design: str) -> float:
        """Root of the mean square over the families."""
        return float(np.sqrt(np.mean(np.square(self.rms_um[design]))))


def robust(
    known: Known,
    *,
    families: Mapping[str, Family] = FAMILIES,
    nominal: ArrayPoses | None = None,
    starts: int = 2,
    seed: int = 0,
    steps: int = 200,
    progress: Callable[[str], None] = lambda done: None,
) -> Robust:
    """Search designs for every family and for their average, and judge all with all.

    All searches are one program. Those for the average begin where the first family's ended too, so
    that no average is worse than that design's.
    """
    if nominal is None:
        nominal = placed(next(iter(POSES.values()))(), ball_line(*NOMINAL))
    names = tuple(families)
    searches = Searches([task(family) for family in families.values()], FREEDOMS[FREEDOM])

    def better(start: ArrayPoses, shares: Sequence[float], count: int) -> Polished:
        return searches.polish(
            start, known, shares=shares, starts=count, seed=seed, steps=steps, tolerance=1e-5
        )

    found: dict[str, Polished] = {}
    for i, name in enumerate(names):
        found[name] = better(nominal, np.eye(len(names))[i].tolist(), starts)
        progress(f"optimised for {name}: {found[name].rms_um:.3f} um")
    evenly = [1.0] * len(names)
    both = better(nominal, evenly, starts), better(found[names[0]].poses, evenly, 1)
    found[AVERAGE] = min(both, key=lambda p: p.rms_um)
    progress(f"optimised for {AVERAGE}: {found[AVERAGE].rms_um:.3f} um")
    rms = {NOMINAL_DESIGN: searches.judge(nominal, known)}
    rms |= {name: best.families_um for name, best in found.items()}
    designs = {NOMINAL_DESIGN: nominal} | {name: best.poses for name, best in found.items()}
    return Robust(known, names, designs, rms)
