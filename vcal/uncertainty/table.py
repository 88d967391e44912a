"""Budgets and comparisons as Markdown tables."""

import math
from collections.abc import Sequence

from .budget import Budget, Row
from .comparison import Comparison

_NONE = "–"
_MINUS = "−"
_ROUNDING = 1e-9
"""Share of u below which a contribution is a rounding error of c and shown as zero."""


def budget_table(budget: Budget, output: str | None = None) -> str:
    """The uncertainty budget of one output, and its result below (JCGM 100, 7.2.7 and H.1).

    `output` is optional for a budget of one output. Raises `ValueError` for an unknown name, and
    for several outputs without a name.
    """
    if output is None:
        if len(budget.labels) != 1:
            raise ValueError(
                f"the budget has {len(budget.labels)} outputs, {budget.labels[0]!r} is the first; "
                "name the one to show"
            )
        output = budget.labels[0]
    i = budget.index(output)
    heads = ("input", "value", "u", "distribution", "dof", "sensitivity", "contribution", "share")
    lines = [_cells(row, float(budget.u[i])) for row in budget.rows(output)]
    value, u = _rounded(float(budget.value[i]), float(budget.u[i]))
    low, high = budget.interval(output)
    places = _places(float(budget.U[i]))
    result = (
        f"{output} = {value}, u = {u}, "
        f"ν_eff = {_dof(float(budget.nu_eff[i]))}, k = {budget.k[i]:.2f}, "
        f"U = {_fixed(float(budget.U[i]), places)} ({100.0 * budget.coverage:g} %): "
        f"[{_fixed(low, places)}, {_fixed(high, places)}]"
    )
    notes = [f"- {note}" for note in budget.notes]
    return "\n\n".join(
        [_table(heads, "lrrlrrrr", lines), result, *(["\n".join(notes)] if notes else [])]
    )


def comparison_table(comparison: Comparison) -> str:
    """GUM and Monte Carlo side by side, with the verdict of JCGM 101, clause 8, per output."""
    heads = ("output", "method", "y", "u", "low", "high", "δ", "d_low", "d_high", "verdict")
    lines = []
    for i, label in enumerate(comparison.labels):
        delta = float(comparison.delta[i])
        places = _places(delta)
        for way, method in enumerate(("GUM", "Monte Carlo")):
            numbers = (comparison.value, comparison.u, comparison.low, comparison.high)
            cells = [_fixed(float(column[i, way]), places) for column in numbers]
            if way == 0:
                lines.append([label, method, *cells, "", "", "", ""])
                continue
            apart = (float(comparison.d_low[i]), float(comparison.d_high[i]))
            verdict = comparison.verdicts[i]
            lines.append(["", method, *cells, *(_number(x, 2) for x in (delta, *apart)), verdict])
    return _table(heads, "llrrrrrrrl", lines)


def _cells(row: Row, combined: float) -> list[str]:
    share = f"{100.0 * row.share:.1f} %".replace("-", _MINUS)
    if row.value is None or row.u is None or row.dof is None:
        return [row.name, *[""] * 6, share]
    c, part = row.sensitivity or 0.0, row.contribution or 0.0
    if part < _ROUNDING * combined:
        c = part = 0.0
    return [
        row.name,
        *_rounded(row.value, row.u),
        row.distribution or "",
        _dof(row.dof),
        _number(c, 4),
        _number(part, 3),
        share,
    ]


def _table(heads: Sequence[str], align: str, lines: Sequence[Sequence[str]]) -> str:
    rule = ["---:" if side == "r" else "---" for side in align]
    rows = [heads, rule, *lines]
    return "\n".join(
        "| " + " | ".join(cell.replace("|", "\\|") for cell in row) + " |" for row in rows
    )


def _rounded(value: float, u: float) -> tuple[str, str]:
    """A value and its uncertainty to two significant digits of the latter (JCGM 100, 7.2.6)."""
    if not math.isfinite(u) or u <= 0.0:
        return _number(value, 6), _number(u, 2)
    places = _places(u)
    return _fixed(value, places), _fixed(u, places)


def _places(u: float) -> int | None:
    """Decimal places for two significant digits; None where a power of ten is needed."""
    if not math.isfinite(u) or u <= 0.0:
        return None
    exponent = int(f"{u:.1e}".partition("e")[2])
    return 1 - exponent


def _fixed(value: float, places: int | None) -> str:
    if not math.isfinite(value):
        return _NONE
    if places is None or places > 6 or places < -5:
        digits = 6 if places is None else _digits(value, places)
        return _number(value, digits)
    return f"{round(value, places):.{max(places, 0)}f}".replace("-", _MINUS)


def _digits(value: float, places: int) -> int:
    """Significant digits that end at a decimal place."""
    if value == 0.0:
        return 1
    return max(int(f"{value:.0e}".partition("e")[2]) + places + 1, 1)


def _number(value: float, digits: int) -> str:
    if math.isnan(value):
        return _NONE
    return f"{value:.{digits}g}".replace("-", _MINUS).replace("inf", "∞")


def _dof(value: float) -> str:
    return "∞" if math.isinf(value) else f"{value:.3g}"
