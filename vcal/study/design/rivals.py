"""The two effects that a further measurement is to separate, named by a user or by the loop."""

import dataclasses
from collections.abc import Sequence
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np

from ...design.optimiser import Task
from ...design.plan_space import joint_information
from ...design.separation import Rival, Separation
from ...effects.base import Effect, Setup
from ...errors import StudyError
from ...loop.outcome.closure import Closure, FoundEffect
from ...words import counted
from ..simulated import parse_with
from ..study import Study


class Wanted(NamedTuple):
    """Two effects to separate, and how the declared model changes for that."""

    rivals: tuple[Rival, Rival]
    declared: tuple[Effect, ...]
    """Declared effects that equal one of the rivals, to be left out of the model."""
    others: tuple[Effect, ...] = ()
    """Further effects found by the loop, to be added to the model."""


def parse_rivals(texts: Sequence[str], study: Study) -> Wanted:
    """The rivals in two texts such as ``backlash:Y`` or ``scale_growth:Y:alpha_um_per_m_K=8``.

    An effect without a value has the size of its prior. Raises `StudyError` for a number of texts
    other than two, for an effect that is not systematic, and as `parse_with` does.
    """
    if len(texts) != 2:
        raise StudyError(
            f"--separate: found {counted(len(texts), 'effect')}, expected two; give "
            "the option twice, such as --separate backlash:Y --separate scale_growth:Y"
        )
    place, files = _setup(study), study.files
    rivals = []
    for text in texts:
        try:
            rivals.append(Rival.of(parse_with(text, study.catalogue, place, files)))
        except StudyError as error:
            raise StudyError(str(error).replace(f"--with {text}", f"--separate {text}")) from error
        except ValueError as error:  # a random effect has no amplitude to fit
            raise StudyError(f"--separate {text}: {error}") from error
        if rivals[-1].effect.kind != "systematic":
            raise StudyError(
                f"--separate {text}: found a {rivals[-1].effect.kind} effect, expected a "
                "systematic one; name another"
            )
    return Wanted((rivals[0], rivals[1]), _declared(study, rivals))


def rivals_of(closure: Closure, study: Study, task: Task) -> Wanted | None:
    """The last effect that the loop found with status ``ambiguous``, and its most probable rival.

    None where no effect is ambiguous. The effect has its estimated size, the rival the size of its
    prior. Where several effects share the rival's name and placement, the one that is hardest to
    separate from the first effect is taken.
    """
    ambiguous = [found for found in closure.effects if found.status == "ambiguous"]
    if not ambiguous:
        return None
    found = ambiguous[-1]
    first = Rival.of(_estimated(found))
    others = tuple(_estimated(f) for f in closure.effects if f is not found)
    names = [f"{name} {place}".strip() for name, place, _ in found.alternatives]
    for key in (*names, *found.equivalent):
        options = _instances(key, study)
        if options:
            best = min(options, key=lambda rival: _smaller_lambda(task, first, rival))
            return Wanted((first, best), _declared(study, [first, best]), others)
    return None


def _estimated(found: FoundEffect) -> Effect:
    values = tuple((name, value, 0.0) for name, value, _, _ in found.parameters)
    return dataclasses.replace(found.effect, given=values, priors=())


def _instances(key: str, study: Study) -> list[Rival]:
    """The rivals of a name and placement that have no free shape."""
    setup, found = _setup(study), []
    for cls in study.catalogue.values():
        if cls.kind != "systematic":
            continue
        for effect in cls.candidates(setup):
            if effect.key == key and not effect.shapes and study.plan.has(*effect.needs):
                found.append(Rival.of(effect))
    return found


def _smaller_lambda(task: Task, first: Rival, second: Rival) -> float:
    """The smaller noncentrality of two rivals on the present data; infinite where they are not
    separable at all.
    """
    space = task.space
    try:
        separation = Separation.of(task.families[0].model, first, second)
    except StudyError:
        return np.inf
    joint = joint_information(space, space.nominal, separation.model)
    return float(np.asarray(separation.lambdas(jnp.asarray(joint), space.shared)).min())


def _declared(study: Study, rivals: Sequence[Rival]) -> tuple[Effect, ...]:
    keys = {(r.effect.key, tuple(p.name for p in r.effect.parameters)) for r in rivals}
    return tuple(
        e for e in study.model.effects if (e.key, tuple(p.name for p in e.parameters)) in keys
    )


def _setup(study: Study) -> Setup:
    return study.model.setup(study.plan)
