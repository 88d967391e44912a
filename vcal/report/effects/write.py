"""Writing the pages of the effects catalogue."""

from collections.abc import Mapping, Sequence
from pathlib import Path

from ...effects.base import Effect
from ..html.folder import Contents, ReportFolder
from ..html.provenance import versions
from .page import Example, catalogue, page
from .pictures import picture

_FOLDER = ReportFolder("effects.json", "vcal-effects/")


def write_effects(
    effects: Sequence[type[Effect]], examples: Mapping[str, Example | None], out: Path | str
) -> Path:
    """Write a page per effect into the folder `out`, and a list of them where there are several.

    Returns the path of the list, or of the only page. Raises `StudyError` as
    `ReportFolder.check` does.
    """

    def make(work: Path) -> Contents:
        drawn = {name: picture(*example) for name, example in examples.items() if example}
        texts = {f"{e.name}.html": page(e, examples[e.name], drawn.get(e.name)) for e in effects}
        if len(effects) > 1:
            texts["index.html"] = catalogue(effects)
        record = {"schema": f"{_FOLDER.schema}1", "versions": versions()}
        return Contents(record, texts, list(drawn.values()))

    return _FOLDER.publish(
        out, make, "index.html" if len(effects) > 1 else f"{effects[0].name}.html"
    )
