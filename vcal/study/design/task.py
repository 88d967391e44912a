"""The design task of a study: its ``[design]`` table, checked and made ready for the search."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Self

from ...design.criteria import CRITERIA, Judged
from ...design.judged import judge
from ...design.optimiser import Task
from ...design.plan_space import PlanSpace, Subject
from ...design.spaces import SPACES
from ...effects.base import Effect
from ...effects.geometric import GeometricErrors
from ...model.forward import Model
from ...registry import nearest
from ..consent import require_inside
from ..folder import Folder
from ..geometric_family import geometric_errors
from ..messages import listed, refusal
from ..must_see import check_identifiable, check_wanted
from ..settings import validate
from ..study import Study, build_chain
from ..toml_file import read_setup


@dataclass(frozen=True)
class StudyDesign:
    """The ``[design]`` table of a study, checked, with its further families read."""

    study: Study
    families: tuple[Effect, ...]
    """Geometric errors of the studies in ``design.families``, in that order."""

    @classmethod
    def of(cls, study: Study) -> Self:
        """Check what does not depend on the judged model, and read the families.

        Raises `StudyError` for an instrument without a design space, for rotary axes that its space
        cannot place, for an unknown error in ``design.must_see``, and for families of another
        machine.
        """
        settings = study.single.design
        _check_space(study)
        check_wanted(settings.must_see, study.chain, study.path.name, "design.must_see")
        return cls(study, tuple(_family(study, name) for name in settings.families))

    def task(self, leave_out: Sequence[Effect] = (), found: Sequence[Effect] = ()) -> Task:
        """The space of the study's plan, the judged families and the criterion.

        Declared effects in `leave_out` are not part of the judged model; the effects in `found`
        are added to it. Raises `StudyError` for a model without errors, for errors that are not
        declared, and for bounds that no plan satisfies.
        """
        study, file, settings = self.study, self.study.path.name, self.study.single.design
        model = judged_model(study, leave_out).with_effects(*found)
        if not model.entries:
            raise refusal(
                file,
                "table model",
                "no declared error, so that there is nothing to design for",
                "a [model.geometric] or effects",
                "declare the expected errors",
            )
        own = judge(model, study.plan, settings.grid, settings.errors)
        _check_errors(study, own)
        families = (own, *(self._varied(model, family) for family in self.families))
        if settings.goal == "volume" and not own.gram.raw.any():
            raise refusal(
                file,
                "key design.goal",
                "'volume' with declared effects of which none moves the tool",
                "errors of the machine",
                "declare some, or choose another goal",
            )
        subject = Subject(study.chain, study.one.instrument, study.plan, file)
        # pydantic has reported its mistakes before; a space raises for one mistake at a time.
        space = SPACES[study.one.settings.kind].of(subject, model, settings)
        return Task(space, families, CRITERIA[settings.goal]())

    def _varied(self, model: Model, family: Effect) -> Judged:
        """The judged model with the geometric errors of another family."""
        study, settings = self.study, self.study.single.design
        others = [e for e in (*model.effects, *model.random) if e.name != GeometricErrors.name]
        varied = Model(study.chain, study.instrument, (family, *others))
        return judge(varied, study.plan, settings.grid, settings.errors)


def design_task(study: Study) -> Task:
    """The design task of a study as declared; raises as `StudyDesign` does."""
    return StudyDesign.of(study).task()


def _check_space(study: Study) -> None:
    """Raise `StudyError` where no space holds plans of this instrument on this machine."""
    kind, file = study.one.settings.kind, study.path.name
    if kind not in SPACES:
        raise refusal(
            file,
            "key instrument.kind",
            f"{kind!r}, for which no design space exists",
            f"one of {listed(SPACES)}",
            "judge plans of your own with `vcal uncertainty`",
        )
    if any(joint.kind == "rotary" for joint in study.chain.joints) and not SPACES[kind].rotary:
        turning = [name for name, space in SPACES.items() if space.rotary]
        raise refusal(
            file,
            "key machine.chain",
            f"{study.chain.text!r}, with rotary axes",
            f"linear axes only, as the design space of {kind!r} places no rotary axes, or the "
            f"instrument kind {listed(turning)}",
            "write a plan that turns the axes, and judge it with `vcal uncertainty`",
        )


def _check_errors(study: Study, own: Judged) -> None:
    """Raise `StudyError` where ``design.errors`` names errors that the judged model lacks."""
    file, settings = study.path.name, study.single.design
    known = [motion.name for motion in own.motions]
    for i, name in enumerate(settings.errors or ()):
        if name not in known:
            raise refusal(
                file,
                f"key design.errors.{i}",
                f"the error {name!r}{nearest(name, known)}, which is not declared",
                f"one of {listed(known)}",
                "correct or remove it",
            )
    if settings.goal == "determinant":
        own_errors = [motion.name for motion in own.motions if motion.amplitudes]
        for i, name in enumerate(settings.errors or ()):
            if name not in own_errors:
                raise refusal(
                    file,
                    f"key design.errors.{i}",
                    f"{name!r} with the goal 'determinant', which takes coefficients of the model",
                    f"one of {listed(own_errors)}",
                    "name these, or set the goal 'largest'",
                )
    if settings.errors == ():
        raise refusal(
            file,
            "key design.errors",
            "an empty list",
            "at least one error",
            "name one, or remove the key, so that all declared errors count",
        )


def judged_model(study: Study, leave_out: Sequence[Effect] = ()) -> Model:
    """The declared model without the instrument's own effects, which the space represents."""
    own = {effect.key for effect in study.instrument.effects(study.plan)}
    every = (*study.model.effects, *study.model.random)
    kept = [e for e in every if e.key not in own and not any(e is other for other in leave_out)]
    return Model(study.chain, study.instrument, kept)


def check_designed(study: Study, space: PlanSpace, placed: Any) -> None:
    """Raise `StudyError` where a plan does not identify the errors in ``[design] must_see``."""
    check_identifiable(
        study.single.design.must_see,
        study.chain,
        space.instrument(placed),
        space.plan(placed),
        study.path.name,
        "design.must_see",
    )


def _family(study: Study, name: str) -> Effect:
    """The geometric errors of the study file `name`, which has to describe the same machine."""
    path = study.folder / name
    require_inside(study.folder, name, allowed=study.allow_outside)
    raw, given = read_setup(path)
    folder = Folder(path.parent, study.trust, study.allow_outside)
    settings = validate(raw, name, given, folder)
    chain = build_chain(settings.machine, name, folder)
    same = [
        (j.name, j.kind, j.side, *j.travel.tolist(), *j.before.ravel().tolist())
        for j in chain.joints
    ] == [
        (j.name, j.kind, j.side, *j.travel.tolist(), *j.before.ravel().tolist())
        for j in study.chain.joints
    ]
    if not same or chain.text != study.chain.text:
        raise refusal(
            study.path.name,
            "key design.families",
            f"{name!r}, a study of another machine ({chain.text!r} or its travel)",
            f"a study of the same machine, {study.chain.text!r}",
            "correct its [machine], or remove it from the list",
        )
    if settings.model.geometric is None:
        raise refusal(
            study.path.name,
            "key design.families",
            f"{name!r}, which has no [model.geometric]",
            "a study file that declares one",
            "declare a family there, or remove it from the list",
        )
    return geometric_errors(settings.model.geometric, study.chain, folder, name)
