"""A file with an effect of the user's own to start from, where no tested effect fits."""

import json

import numpy as np

from ...identification.fit import Fit
from ...instruments.conditions import file_name
from ...loop.empirical import Empirical
from ...loop.outcome.closure import Closure
from ...loop.weighing.rivals import Rival
from ...machine.plan import Plan
from ...plots import values_of

FILE = "own_effect.py"
_HEAD = '''"""An effect of your own, to start from.

{found}

Its form and numbers were taken from these data: tested on them again, its p-value is too small.
Give it a name and a reason, correct `response`, and name this file in the study:

    [model]
    effects_file = "own_effect.py"

`vcal loop --trust` then runs this file and tests it beside the catalogue.
"""

import jax.numpy as jnp

import vcal


class OwnEffect(vcal.Effect):
    """Definition, formula, and source."""

    name = "own_effect"
    summary = "description in one line"

    @property
    def parameters(self):
        # Name, unit, standard deviation of the prior.
        return ({parameters},)

    @property
    def needs(self):
        # Axes and columns that it depends on.
        return ({needs},)

    def response(self, plan, shape):
        # Deviation of every port per SI unit of every parameter, one value per row.
{body}

    @classmethod
    def candidates(cls, setup):
        yield cls({placement})
'''


def own_effect(closure: Closure) -> str | None:
    """The text of the file; None where nothing is unexplained or no covariate orders the residual.

    An empirical description that can be written as Python code is written as it was found, with
    free sizes. Otherwise the effect has a slope and a curvature of the first two covariates along
    every direction of the residual, and their product where the residual depends on it. Covariates
    that only some rows have are left out.
    """
    what = closure.unexplained
    if what is None or not what.depends_on:
        return None
    plan = closure.after.measurement.plan
    found = _in_docstring(f"vcal found: {what.reason}.")
    best = what.empirical.effect if what.empirical is not None else None
    if what.empirical is not None and isinstance(best, Empirical) and best.coded:
        return _as_described(found, what.empirical, plan)
    whole = [n for n in what.depends_on if n not in plan.groups and _of_all_rows(n, plan)]
    names = whole[:2]
    if not names:
        return None
    fit = closure.after
    ways = what.direction if what.direction in fit.ways else fit.ways
    unit, arm = ("urad", _lever(fit)) if fit.angular.all() else ("um", 1.0)
    size = max(2.0 * what.size_um / arm, 1.0)
    parameters, lines, terms = [], [], []
    for i, name in enumerate(names, start=1):
        x = values_of(name, plan)
        middle, half = 0.5 * float(x.max() + x.min()), 0.5 * float(np.ptp(x)) or 1.0
        lines.append(
            f"        u{i} = ({_read(name, plan)} - {middle:.6g}) / {half:.4g}"
            f"  # {' '.join(file_name(name, plan.axes).split())}, -1 to 1"
        )
        for c in ways:
            for kind, power in (("slope", f"u{i}"), ("curve", f"u{i} * u{i}")):
                label = f"{kind}{i}_{c}"
                parameters.append(f'vcal.Parameter("{label}", "{unit}", sigma={size:.3g})')
                terms.append(f'            ("tool.{c}", "{label}"): {power},')
    if what.joint and len(names) == 2 and names == what.depends_on[:2]:
        for c in ways:
            parameters.append(f'vcal.Parameter("both_{c}", "{unit}", sigma={size:.3g})')
            terms.append(f'            ("tool.{c}", "both_{c}"): u1 * u2,')
    return _HEAD.format(
        found=found,
        parameters=",\n            ".join(parameters),
        needs=", ".join(map(_quoted, names)),
        body="\n".join([*lines, "        return {", *terms, "        }"]),
        placement="",
    )


def _lever(fit: Fit) -> float:
    """Mean lever arm of angle readings, m."""
    given = fit.measurement
    return float(fit.model.instrument.lengths(given.plan, given.readings).mean()) or 1.0


def _as_described(found: str, best: Rival, plan: Plan) -> str:
    effect, fit = best.effect, best.fit
    assert isinstance(effect, Empirical)
    shape = fit.shapes.get(len(fit.model.effects) - 1, {})
    lines, terms = effect.code(plan, shape, lambda name: _read(name, plan))
    values = {p.name: value for _, p, value, _ in fit.values_of(len(fit.model.effects) - 1)}
    needed = dict.fromkeys([*effect.needs, *effect.depends_on(plan, shape)])
    parameters = [
        f'vcal.Parameter("{p.name}", "{p.unit}", sigma={max(2.0 * abs(values[p.name]), 1.0):.3g})'
        for p in effect.amplitudes
    ]
    returned = [
        f'            ("{port}", "{name}"): {term},' for (port, name), term in terms.items()
    ]
    return _HEAD.format(
        found=found,
        parameters=",\n            ".join(parameters),
        needs=", ".join(map(_quoted, needed)),
        body="\n".join(
            [*(f"        {line}" for line in lines), "        return {", *returned, "        }"]
        ),
        placement=f"placement={_quoted(effect.placement)}",
    )


def _of_all_rows(name: str, plan: Plan) -> bool:
    return name.partition(":")[0] not in plan.sets and bool(np.isfinite(plan.values(name)).all())


def _read(name: str, plan: Plan) -> str:
    quoted = _quoted(name)
    if name in plan.axes:
        return f"plan.x({quoted})"
    return f"plan.groups[{quoted}]" if name in plan.groups else f"plan.covariate({quoted})"


def _quoted(name: str) -> str:
    """A column name as Python text: JSON and Python escape alike."""
    return json.dumps(name, ensure_ascii=False)


def _in_docstring(words: str) -> str:
    """Text that neither ends a docstring nor escapes anything in it."""
    return words.replace("\\", "\\\\").replace('"', '\\"')
