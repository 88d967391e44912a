"""Two effects that a measurement is to tell apart: as a user or the loop names them."""

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
from ..simulated import parse_with
from ..study import Study


class Wanted(NamedTuple):
    """Two effects to tell apart, and the declared effects that are one of them."""

    rivals: tuple[Rival, Rival]
    declared: tuple[Effect, ...]
    """To be left out of the declared model."""
    others: tuple[Effect, ...] = ()
    """Found by the loop beside them: to be added to the declared model."""


def parse_rivals(texts: Sequence[str], study: Study) -> Wanted:
    """From two texts such as ``backlash:Y`` or ``scale_growth:Y:alpha_um_per_m_K=8``; without a
    value an effect has the size of its prior.

    Raises `StudyError` for another number than two, and as `parse_with` does.
    """
    if len(texts) != 2:
        raise StudyError(
            f"--separate: found {len(texts)} effect{'s' * (len(texts) != 1)}, expected two; give "
            "the option twice, such as --separate backlash:Y --separate scale_growth:Y"
        )
    place, files = _setup(study), study.files
    rivals = []
    for text in texts:
        try:
            rivals.append(Rival.of(parse_with(text, study.catalogue, place, files)))
        except StudyError as error:
            raise StudyError(str(error).replace(f"--with {text}", f"--separate {text}")) from error
        except ValueError as error:  # a random effect has no amplitude that could be fitted
            raise StudyError(f"--separate {text}: {error}") from error
        if rivals[-1].effect.kind != "systematic":
            raise StudyError(
                f"--separate {text}: found a {rivals[-1].effect.kind} effect, expected a "
                "systematic one; name another"
            )
    return Wanted((rivals[0], rivals[1]), _declared(study, rivals))


def rivals_of(closure: Closure, study: Study, task: Task) -> Wanted | None:
    """The effect that the loop named without certainty last, with its most probable rival; None
    where there is no doubt.

    The effect has the size that was estimated, its rival that of its prior. Where several effects
    have the rival's name and place, it is the one that is hardest to tell from the first.
    """
    doubtful = [found for found in closure.effects if found.status == "ambiguous"]
    if not doubtful:
        return None
    found = doubtful[-1]
    first = Rival.of(_estimated(found))
    others = tuple(_estimated(f) for f in closure.effects if f is not found)
    names = [f"{name} {place}".strip() for name, place, _ in found.alternatives]
    for key in (*names, *found.equivalent):
        options = _instances(key, study)
        if options:
            best = min(options, key=lambda rival: _told(task, first, rival))
            return Wanted((first, best), _declared(study, [first, best]), others)
    return None


def _estimated(found: FoundEffect) -> Effect:
    values = tuple((name, value, 0.0) for name, value, _, _ in found.parameters)
    return dataclasses.replace(found.effect, given=values, priors=())


def _instances(key: str, study: Study) -> list[Rival]:
    """Effects of that name and place without a free shape."""
    setup, found = _setup(study), []
    for cls in study.catalogue.values():
        if cls.kind != "systematic":
            continue
        for effect in cls.candidates(setup):
            if effect.key == key and not effect.shapes and study.plan.has(*effect.needs):
                found.append(Rival.of(effect))
    return found


def _told(task: Task, first: Rival, second: Rival) -> float:
    """Smaller lambda of two rivals by the data as they are."""
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
