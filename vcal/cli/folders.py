"""The studies to start from that come with the package, and what they tell of an effect."""

import shutil
import tempfile
from pathlib import Path

from ..catalogue import nearest
from ..demo import FOLDER
from ..effects.base import Effect, Setup
from ..errors import StudyError
from ..io import load_study
from ..io.messages import listed
from ..io.simulated import publish, require_empty

_STARTS = FOLDER / "start"


def starts() -> list[str]:
    """Instruments for which there is a study to start from."""
    return sorted(entry.name for entry in _STARTS.iterdir() if entry.is_dir())


def write_start(instrument: str, out: Path) -> list[str]:
    """Copy the study to start from for an instrument to `out`; names of the files written.

    Raises `StudyError` for an instrument without one, and where `out` is there and not empty.
    """
    known = starts()
    if instrument not in known:
        raise StudyError(
            f"--instrument: found {instrument!r}{nearest(instrument, known)}, expected one of "
            f"{listed(known)}; correct the name"
        )
    require_empty(out)
    out.parent.mkdir(parents=True, exist_ok=True)
    work = Path(tempfile.mkdtemp(prefix=f".{out.name}-", dir=out.parent))
    try:
        names = []
        for entry in (_STARTS / instrument).iterdir():
            shutil.copyfile(entry, work / entry.name)
            names.append(entry.name)
        publish(work, out)
    except BaseException:
        shutil.rmtree(work, ignore_errors=True)
        raise
    return sorted(names)


def example(effect: type[Effect]) -> tuple[Effect, Setup] | None:
    """An instance of an effect on a bundled study where it has a place; None if there is none.

    Raises `RuntimeError` where JAX runs in float32.
    """
    for instrument in starts():
        study = load_study(_STARTS / instrument)
        artefact = study.instrument.artefact
        setup = Setup(study.chain, study.model.layout, study.plan, study.model.effects, artefact)
        for instance in effect.candidates(setup):
            return instance, setup
    return None
