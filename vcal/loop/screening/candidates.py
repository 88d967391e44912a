"""Which effects could be missing: every class of the catalogue, at every place it can have."""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace

from ...effects.base import Effect, Fitted
from ...effects.data_set import in_setup
from ...effects.reference import with_free_reference, with_known_reference
from ...identification.fit import Fit
from ...machine.plan import Plan
from ...model.forward import Model
from ...model.measurement import Measurement


@dataclass(frozen=True)
class Untestable:
    """An effect that cannot be tested with these data, and the reason."""

    effect: str
    placement: str
    reason: str
    missing: tuple[tuple[str, tuple[str, ...]], ...] = ()
    """Covariates that it needs, each with the data sets that lack it. The data sets are empty where
    there is only one, or where all have the covariate and do not share it."""


class UntestableError(ValueError):
    """None of the requested effects can be tested with these data.

    `untestable` lists them with the reasons; it is empty where none has a place on the machine.
    """

    def __init__(self, untestable: Sequence[Untestable]):
        self.untestable = list(untestable)
        reasons = "; ".join(self.reasons) or "no place for them"
        super().__init__(f"none of the requested effects can be tested ({reasons})")

    @property
    def reasons(self) -> list[str]:
        """``"effect: reason"`` of each kind, sorted."""
        return sorted({f"{item.effect}: {item.reason}" for item in self.untestable})


def candidates(
    model: Model,
    measurement: Measurement,
    classes: Iterable[type[Effect]],
    beside: Iterable[Effect] = (),
    fit: Fit | None = None,
) -> tuple[list[Effect], list[Untestable]]:
    """Candidate effects: those that the data can test, and those that lack a covariate.

    `classes` are instantiated at every place that the model and the plan offer, without what the
    model has already; an effect with an uncertain reference value twice, with the declared value
    and with a free one (`FreeReference`). `beside` are effects that are tried too: the covariates
    that they need count as used. `fit` gives the values of the effects of the model, for candidates
    that modify one of them. The first list has the testable instances in the order of `classes`;
    the second an `Untestable` for each of the others.
    """
    plan = measurement.plan
    used = frozenset(name for effect in beside for name in effect.needs)
    setup = replace(model.setup(plan), used=used, fitted=_fitted(fit) if fit else ())
    present = {_identity(effect) for effect in model.effects}
    found, missing = [], {}
    for cls in classes:
        if cls.kind != "systematic":
            continue
        for effect in _each(in_setup(cls, setup)):
            if _identity(effect) in present:
                continue
            absent = [name for name in effect.needs if not plan.has(name)]
            if absent:
                missing[effect.name, effect.placement] = [_wanting(plan, name) for name in absent]
            else:
                found.append(effect)
    return found, [
        Untestable(name, place, "; ".join(_reasons(wanted, plan.sets)), tuple(wanted))
        for (name, place), wanted in missing.items()
    ]


def _fitted(fit: Fit) -> tuple[Fitted, ...]:
    found = []
    for place, effect in enumerate(fit.model.effects):
        if effect.kind == "systematic":
            values = {p.name: float(v) * p.si for _, p, v, _ in fit.values_of(place) if not p.shape}
            shape = {name: float(v) for name, v in fit.shapes.get(place, {}).items()}
            found.append(Fitted(effect, shape, values))
    return tuple(found)


def _wanting(plan: Plan, name: str) -> tuple[str, tuple[str, ...]]:
    """A covariate that is absent, and the data sets that lack it."""
    owner, _, plain = name.partition(":")
    return (plain, (owner,)) if owner in plan.sets else (name, plan.lacking(name))


def _reasons(wanted: list[tuple[str, tuple[str, ...]]], sets: tuple[str, ...]) -> list[str]:
    """Why covariates are absent, in words; covariates that the same data sets lack share one
    reason.
    """
    alike: dict[tuple[str, ...], list[str]] = {}
    for name, lacking in wanted:
        alike.setdefault(lacking, []).append(name)
    reasons = []
    for lacking, names in alike.items():
        listed = ", ".join(names)
        if not sets or lacking == sets:
            reasons.append(f"the data have no {listed}")
        elif not lacking:
            reasons.append(f"the data sets do not share their {listed}")
        else:
            reasons.append(
                f"{' and '.join(lacking)} {'have' if lacking[1:] else 'has'} no {listed}"
            )
    return reasons


def _each(effects: Iterable[Effect]) -> Iterator[Effect]:
    """The effects, each followed by itself with a free reference value, where it has one."""
    for effect in effects:
        yield effect
        if (free := with_free_reference(effect)) is not None:
            yield free


def _identity(effect: Effect) -> tuple[str, str, tuple[str, ...]]:
    effect = with_known_reference(effect)
    return effect.name, effect.placement, tuple(p.name for p in effect.parameters)
