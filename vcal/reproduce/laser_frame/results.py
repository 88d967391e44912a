"""The whole of a reproduction as numbers."""

from collections.abc import Callable
from dataclasses import dataclass

from .better import Better, better
from .budget import Figure, figures
from .cycles import Cycles, Fitted, Machine, cycles, influences
from .recipe import Variant, variants
from .seen import Seen, seen
from .setting import LEVER_M, Layout
from .verification import Verification, verification

CYCLES = 30_000
LEAST = 200
"""Cycles of the smallest campaign."""

_CAMPAIGNS: dict[str, tuple[str, Machine, Fitted]] = {
    "planar, noise": ("planar", "none", "thirteen with prior"),
    "planar, all errors": ("planar", "all", "thirteen with prior"),
    "3d, noise": ("3d", "none", "thirteen"),
    "3d, all errors": ("3d", "all", "thirteen"),
    "3d, all errors fitted": ("3d", "all", "all with prior"),
}
"""Path, what is drawn, and what is fitted."""


@dataclass(frozen=True)
class Results:
    """Everything that was computed."""

    seed: int
    draws: int
    figures: tuple[Figure, ...]
    seen: dict[str, Seen]
    """By path and lever."""
    variants: tuple[Variant, ...]
    cycles: dict[str, Cycles]
    as_effects: dict[str, Cycles]
    """With the influences as effects, by path."""
    verification: Verification
    better: Better
    checked: dict[str, Cycles]
    """Monte Carlo on the layouts found."""


def compute(draws: int, seed: int, progress: Callable[[str], None]) -> Results:
    """Everything; campaigns have `draws` cycles, the second device a thirtieth of them."""
    progress("budget")
    found = figures()
    progress("what the beams see")
    looks = {
        "“3d”": seen("3d"),
        "“planar”": seen("planar"),
        f"“3d”, lever {1e3 * LEVER_M:g} mm": seen("3d", LEVER_M),
    }
    campaigns = {}
    for name, (path, machine, fitted) in _CAMPAIGNS.items():
        progress(f"cycles: {name}")
        campaigns[name] = cycles(path, machine, fitted, draws=draws, seed=seed)
    as_effects = {}
    for path, fitted in (("3d", "thirteen"), ("planar", "thirteen with prior")):
        progress(f"influences as effects, path {path}")
        own = influences(Layout.named(path))
        every = [effect for group in own.values() for effect in group]
        as_effects[path] = cycles(path, "none", fitted, draws=draws, seed=seed, effects=every)  # type: ignore[arg-type]
    progress("second device")
    checks = verification(max(draws // 30, LEAST), seed)
    layouts = better(progress)
    checked = {layouts.steps[0].freedom: campaigns["3d, noise"]}
    for step in layouts.steps[-2:]:
        progress(f"Monte Carlo: {step.freedom}")
        checked[step.freedom] = cycles(step.layout, "none", "thirteen", draws=draws, seed=seed)
    return Results(
        seed=seed,
        draws=draws,
        figures=found,
        seen=looks,
        variants=variants(),
        cycles=campaigns,
        as_effects=as_effects,
        verification=checks,
        better=layouts,
        checked=checked,
    )
