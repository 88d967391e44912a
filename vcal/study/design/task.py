"""What a study says of the design of its measurement, checked and made ready for the search."""

from collections.abc import Sequence
from typing import Any

from ...design.criteria import CRITERIA, Judged
from ...design.judged import judge
from ...design.optimise import Task
from ...design.plan_space import PlanSpace, Subject
from ...design.spaces import SPACES
from ...effects.base import Effect
from ...effects.geometric import GeometricErrors
from ...model.forward import Model
from ...registry import nearest
from ..folder import Folder
from ..geometric_family import geometric_errors
from ..messages import listed, refusal
from ..must_see import check_identifiable, check_wanted
from ..settings import validate
from ..study import Study, build_chain
from ..toml_file import read_setup


def design_task(
    study: Study, leave_out: Sequence[Effect] = (), found: Sequence[Effect] = ()
) -> Task:
    """The space of a study's plan, the families and the goal of its ``[design]``.

    Effects in `leave_out` are not judged; those `found` beside the declared ones are. Raises
    `StudyError` for an instrument without a space, errors that are not declared, families of
    another machine, and bounds that nothing satisfies.
    """
    kind, file, settings = study.one.settings.kind, study.path.name, study.single.design
    if kind not in SPACES:
        raise refusal(
            file,
            "key instrument.kind",
            f"{kind!r}, of which the plans have no space to search",
            f"one of {listed(SPACES)}",
            "judge plans of your own with `vcal uncertainty`",
        )
    if any(joint.kind == "rotary" for joint in study.chain.joints) and not SPACES[kind].rotary:
        turning = [name for name, space in SPACES.items() if space.rotary]
        raise refusal(
            file,
            "key machine.chain",
            f"{study.chain.text!r}, with rotary axes",
            f"linear axes, as plans of the kind {kind!r} in which others turn are not designed, "
            f"or the kind {listed(turning)}",
            "let the axes turn in a plan of your own, and ask `vcal uncertainty` what it tells",
        )
    check_wanted(settings.must_see, study.chain, file, "design.must_see")
    model = judged_model(study, leave_out).with_effects(*found)
    if not model.entries:
        raise refusal(
            file,
            "table model",
            "no declared error, so that there is nothing to design for",
            "a [model.geometric] or effects",
            "declare what is known in advance",
        )
    own = judge(model, study.plan, settings.grid, settings.errors)
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
                    f"{name!r} with the goal 'determinant', which is one of coefficients that the "
                    "model has",
                    f"one of {listed(own_errors)}",
                    "name these, or ask for the goal 'largest'",
                )
    if settings.errors == ():
        raise refusal(file, "key design.errors", "none", "at least one", "name one, or no list")
    families = (own, *(_family(study, model, name) for name in settings.families))
    if settings.goal == "volume" and not own.gram.raw.any():
        raise refusal(
            file,
            "key design.goal",
            "'volume' with declared effects none of which moves the tool",
            "errors of the machine",
            "declare some",
        )
    subject = Subject(study.chain, study.one.instrument, study.plan, file)
    # Messages of a space tell one mistake, those of pydantic had their turn.
    space = SPACES[kind].of(subject, model, settings)
    return Task(space, families, CRITERIA[settings.goal]())


def judged_model(study: Study, leave_out: Sequence[Effect] = ()) -> Model:
    """The declared model without the instrument's own effects, which a space deals with."""
    own = {effect.key for effect in study.instrument.effects(study.plan)}
    every = (*study.model.effects, *study.model.random)
    kept = [e for e in every if e.key not in own and not any(e is other for other in leave_out)]
    return Model(study.chain, study.instrument, kept)


def check_designed(study: Study, space: PlanSpace, placed: Any) -> None:
    """Raise `StudyError` where a plan does not see what ``[design] must_see`` asks for."""
    check_identifiable(
        study.single.design.must_see,
        study.chain,
        space.instrument(placed),
        space.plan(placed),
        study.path.name,
        "design.must_see",
    )


def _family(study: Study, model: Model, name: str) -> Judged:
    path = study.folder / name
    raw, given = read_setup(path)
    settings = validate(raw, name, given, Folder(path.parent))
    chain = build_chain(settings.machine, name)
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
            f"families of the same machine, {study.chain.text!r}",
            "remove it, or correct its [machine]",
        )
    if settings.model.geometric is None:
        raise refusal(
            study.path.name,
            "key design.families",
            f"{name!r}, which has no [model.geometric]",
            "study files that declare one",
            "remove it, or declare a family there",
        )
    family = geometric_errors(settings.model.geometric, study.chain, Folder(path.parent), name)
    others = [e for e in (*model.effects, *model.random) if e.name != GeometricErrors.name]
    varied = Model(study.chain, study.instrument, (family, *others))
    settings = study.single.design
    return judge(varied, study.plan, settings.grid, settings.errors)
