"""The whole of a reproduction as numbers."""

from functools import partial

from ...uncertainty import Budget
from ..registry import Computed, each, part
from .better import Better, better
from .budget import Facts, Figure, figures, point_budget
from .cycles import Cycles, Fitted, Machine, cycles, influences
from .recipe import Variant, variants
from .seen import Seen, seen
from .setting import LEVER_M, Layout
from .verification import Verification, verification

CYCLES = 30_000
LEAST = 200
"""Cycles of the smallest campaign."""

_LOOKS = {
    "“3d”": ("3d", 0.0),
    "“planar”": ("planar", 0.0),
    f"“3d”, lever {1e3 * LEVER_M:g} mm": ("3d", LEVER_M),
}
"""Path and lever of the diode."""
_CAMPAIGNS: dict[str, tuple[str, Machine, Fitted]] = {
    "planar, noise": ("planar", "none", "thirteen with prior"),
    "planar, all errors": ("planar", "all", "thirteen with prior"),
    "3d, noise": ("3d", "none", "thirteen"),
    "3d, all errors": ("3d", "all", "thirteen"),
    "3d, all errors fitted": ("3d", "all", "all with prior"),
}
"""Path, what is drawn, and what is fitted."""


class Results(Computed):
    """Everything; campaigns have `draws` cycles, the second device a thirtieth of them."""

    @part("budget")
    def figures(self) -> tuple[Figure, ...]:
        return figures()

    @part("the largest uncertainty of a reading")
    def largest(self) -> Budget:
        return point_budget(1.3, Facts().longest)

    @each("what the beams see, {}", _LOOKS)
    def seen(self, name: str) -> Seen:
        return seen(*_LOOKS[name])

    @part("variants of the evaluation")
    def variants(self) -> tuple[Variant, ...]:
        return variants()

    @each("cycles: {}", _CAMPAIGNS)
    def cycles(self, name: str) -> Cycles:
        return cycles(*_CAMPAIGNS[name], draws=self.draws, seed=self.seed)

    @each("influences as effects, path {}", ("3d", "planar"))
    def as_effects(self, path: str) -> Cycles:
        every = [e for group in influences(Layout.named(path)).values() for e in group]
        fitted = _CAMPAIGNS[f"{path}, noise"][2]
        return cycles(path, "none", fitted, draws=self.draws, seed=self.seed, effects=every)

    @part("second device")
    def verification(self) -> Verification:
        return verification(max(self.draws // 30, LEAST), self.seed)

    @part("better places")
    def better(self) -> Better:
        return better(self.progress)

    @part("Monte Carlo on the layouts found")
    def checked(self) -> dict[str, Cycles]:
        """By the freedom of the first step and of the last two."""
        first, *_, last, least = self.better.steps
        campaign = partial(cycles, machine="none", fitted="thirteen", draws=self.draws)
        found = {one.freedom: campaign(one.layout, seed=self.seed) for one in (last, least)}
        return {first.freedom: self.cycles["3d, noise"], **found}
