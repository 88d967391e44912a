"""A file with an effect of the user's own, to start from where none that was tried fits."""

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

`vcal loop` then tries it beside the catalogue.
"""

import jax.numpy as jnp

import vcal


class OwnEffect(vcal.Effect):
    """What it is, its formula, and where that comes from."""

    name = "own_effect"
    summary = "one line on what it is"

    @property
    def parameters(self):
        # Name, unit, standard deviation of what is believed before the measurement.
        return ({parameters},)

    @property
    def needs(self):
        # Axes and columns without which it cannot be evaluated.
        return ({needs},)

    def response(self, plan, shape):
        # Deviation of every port per SI unit of every parameter, one value per row.
{body}

    @classmethod
    def candidates(cls, setup):
        yield cls({placement})
'''


def own_effect(closure: Closure) -> str | None:
    """The text of the file; None where nothing is left unexplained or no covariate orders it.

    An empirical description that has Python for itself becomes what it is, where it was found, with
    its sizes free; another one, and a dependence on covariates, a slope and a curvature of each of
    the first two, along every direction that it has, and their product where it is that which the
    residual depends on. What only some of the rows have is no start for an effect of all.
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
    """Mean lever arm of readings of angles, m."""
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
    """A name of a user's column as Python text: JSON escapes what Python does, in the same way."""
    return json.dumps(name, ensure_ascii=False)


def _in_docstring(words: str) -> str:
    """Words of any kind where they end no docstring of three quotes, and escape nothing in it."""
    return words.replace("\\", "\\\\").replace('"', '\\"')
