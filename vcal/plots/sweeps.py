"""Pictures of a sweep: a result and its uncertainty over one input."""

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from ..uncertainty import Sweep
from .labels import pretty_unit
from .style import AFTER, BEFORE, figure, grid, titled

_WIDE, _HIGH = 3.4, 2.6
"""Size of a panel, inches."""
_MARGINS = {"left": 0.85, "right": 0.25, "top": 0.4, "bottom": 0.6, "wspace": 0.95}


def sweep_view(
    sweep: Sweep,
    output: str | None = None,
    *,
    wanted: float | None = None,
    unit: str = "",
    input_unit: str = "",
) -> Figure:
    """One output of a sweep over the input: y with U as a band, and u, with a `wanted` one dashed.

    `output` is optional for one output; the units are those of the output and of the input. Raises
    `ValueError` for an unknown output, and for several without a name.
    """
    if output is None and len(sweep.labels) != 1:
        raise ValueError(f"the sweep has {len(sweep.labels)} outputs; name the one to draw")
    i = sweep.index(sweep.labels[0] if output is None else output)
    name = sweep.labels[i]
    width = 2 * _WIDE + _MARGINS["left"] + _MARGINS["right"] + _MARGINS["wspace"]
    drawn = figure(width, _HIGH + _MARGINS["top"] + _MARGINS["bottom"])
    left, right = grid(drawn, 1, 2, _MARGINS).flat
    along = sweep.input if sweep.what == "value" else f"u({sweep.input})"
    below = f"{along} / {pretty_unit(input_unit)}" if input_unit else along
    beside = pretty_unit(unit)
    value, U = sweep.value[:, i], sweep.U[:, i]
    left.fill_between(sweep.at, value - U, value + U, color=AFTER, alpha=0.2, lw=0)
    left.plot(sweep.at, value, color=AFTER, lw=1.6)
    titled(left, f"{name} with U ({100.0 * sweep.coverage:g} %)", below, beside)
    _uncertainty(right, sweep, i, wanted)
    titled(right, f"u({name})", below, beside)
    return drawn


def _uncertainty(ax: Axes, sweep: Sweep, i: int, wanted: float | None) -> None:
    ax.plot(sweep.at, sweep.u[:, i], color=AFTER, lw=1.6)
    if wanted is not None:
        ax.axhline(wanted, color=BEFORE, lw=1.2, ls="--", label="wanted")
        ax.legend(loc="best", fontsize=8, frameon=False)
    ax.set_ylim(bottom=0.0)
