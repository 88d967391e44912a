"""Budgets and comparisons as tables: plain text, Markdown, LaTeX or HTML."""

import math

from .budget import Budget, Row
from .comparison import Comparison
from .layouts import Layout, laid_out

_NONE = "–"
_MINUS = "−"
_ROUNDING = 1e-9
"""Share of u below which a contribution is a rounding error of c and shown as zero."""


def budget_table(
    budget: Budget,
    output: str | None = None,
    *,
    digits: int = 2,
    layout: Layout = "markdown",
) -> str:
    """The uncertainty budget of one output, and its result below (JCGM 100, 7.2.7 and H.1).

    `output` is optional for a budget of one output. Uncertainties have this number of significant
    `digits`, values end at the same decimal place (JCGM 100, 7.2.6). `layout` is ``"markdown"``,
    ``"plain"``, ``"latex"`` or ``"html"``.

    Raises `ValueError` for an unknown name, several outputs without a name, a number of digits
    outside 1 to 15, and an unknown layout.
    """
    output = _only(budget, output)
    _check_digits(digits)
    heads = ("input", "value", "u", "distribution", "dof", "sensitivity", "contribution", "share")
    combined = float(budget.u[budget.index(output)])
    lines = [_cells(row, combined, digits) for row in budget.rows(output)]
    return laid_out(
        heads, "lrrlrrrr", lines, result_line(budget, output, digits=digits), budget.notes, layout
    )


def result_line(budget: Budget, output: str | None = None, *, digits: int = 2) -> str:
    """The result of one output: y, u, nu_eff, k and U with its interval (JCGM 100, 7.2).

    Arguments and errors as for `budget_table`. A stated k has no coverage probability.
    """
    output = _only(budget, output)
    _check_digits(digits)
    i = budget.index(output)
    value, u = _rounded(float(budget.value[i]), float(budget.u[i]), digits)
    low, high = budget.interval(output)
    places = _places(float(budget.U[i]), digits)
    stated = budget.stated_k is not None
    dof = _dof(float(budget.nu_eff[i])) + (" (stated)" if budget.stated_dof else "")
    k = f"{budget.stated_k:g} (stated)" if stated else f"{budget.k[i]:.2f}"
    probability = "" if stated else f" ({100.0 * budget.coverage:g} %)"
    return (
        f"{output} = {value}, u = {u}, ν_eff = {dof}, k = {k}, "
        f"U = {_fixed(float(budget.U[i]), places)}{probability}: "
        f"[{_fixed(low, places)}, {_fixed(high, places)}]"
    )


def _only(budget: Budget, output: str | None) -> str:
    """The name of an output, which a budget of one output does not need."""
    if output is None:
        if len(budget.labels) != 1:
            raise ValueError(
                f"the budget has {len(budget.labels)} outputs, {budget.labels[0]!r} is the first; "
                "name the one to show"
            )
        output = budget.labels[0]
    return output


def _check_digits(digits: int) -> None:
    if digits not in range(1, 16):
        raise ValueError(f"digits: found {digits!r}, expected a whole number from 1 to 15")


def comparison_table(comparison: Comparison, *, layout: Layout = "markdown") -> str:
    """GUM and Monte Carlo side by side, with the verdict of JCGM 101, clause 8, per output.

    `layout` as for `budget_table`.
    """
    heads = ("output", "method", "y", "u", "low", "high", "δ", "d_low", "d_high", "verdict")
    lines = []
    for i, label in enumerate(comparison.labels):
        delta = float(comparison.delta[i])
        places = _places(delta, 2)
        for way, method in enumerate(("GUM", "Monte Carlo")):
            numbers = (comparison.value, comparison.u, comparison.low, comparison.high)
            cells = [_fixed(float(column[i, way]), places) for column in numbers]
            if way == 0:
                lines.append([label, method, *cells, "", "", "", ""])
                continue
            apart = (float(comparison.d_low[i]), float(comparison.d_high[i]))
            verdict = comparison.verdicts[i]
            lines.append(["", method, *cells, *(_number(x, 2) for x in (delta, *apart)), verdict])
    notes = "\n".join(f"- {note}" for note in comparison.notes)
    table = laid_out(heads, "llrrrrrrrl", lines, layout=layout)
    return "\n\n".join([table, *([notes] if notes else [])])


def _cells(row: Row, combined: float, digits: int) -> list[str]:
    share = f"{100.0 * row.share:.1f} %".replace("-", _MINUS)
    if row.value is None or row.u is None or row.dof is None:
        return [row.name, *[""] * 6, share]
    c, part = row.sensitivity or 0.0, row.contribution or 0.0
    if part < _ROUNDING * combined:
        c = part = 0.0
    return [
        row.name,
        *_rounded(row.value, row.u, digits),
        row.distribution or "",
        _dof(row.dof),
        _number(c, digits + 2),
        _number(part, digits + 1),
        share,
    ]


def _rounded(value: float, u: float, digits: int) -> tuple[str, str]:
    """A value and its uncertainty to significant digits of the latter (JCGM 100, 7.2.6)."""
    if not math.isfinite(u) or u <= 0.0:
        return _number(value, 6), _number(u, digits)
    places = _places(u, digits)
    return _fixed(value, places), _fixed(u, places)


def _places(u: float, digits: int) -> int | None:
    """Decimal places for significant digits of u; None where it has none."""
    if not math.isfinite(u) or u <= 0.0:
        return None
    exponent = int(f"{u:.{digits - 1}e}".partition("e")[2])
    return digits - 1 - exponent


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
