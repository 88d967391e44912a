"""Writing the pages of the effects catalogue."""

from collections.abc import Mapping, Sequence
from pathlib import Path

from ...effects.base import Effect
from ..html.folder import Contents, ReportFolder
from ..html.provenance import versions
from .page import INDEX, Example, catalogue, page
from .pictures import picture
from .related import related

_FOLDER = ReportFolder("effects.json", "vcal-effects/")


def write_effects(
    effects: Sequence[type[Effect]], examples: Mapping[str, Example | None], out: Path | str
) -> Path:
    """Write a page per effect into the folder `out`, and where there are several, a list
    of them and links from each to the related ones.

    Returns the path of the list, or of the only page. Raises `StudyError` as
    `ReportFolder.check` does.
    """

    def make(work: Path) -> Contents:
        drawn = {name: picture(*example) for name, example in examples.items() if example}
        several = len(effects) > 1
        others = related(effects, examples) if several else {}
        summaries = {e.name: e.summary for e in effects}
        texts = {
            f"{e.name}.html": page(
                e, examples[e.name], drawn.get(e.name), others.get(e.name), summaries
            )
            for e in effects
        }
        if several:
            texts[INDEX] = catalogue(effects)
        record = {"schema": f"{_FOLDER.schema}1", "versions": versions()}
        return Contents(record, texts, list(drawn.values()))

    return _FOLDER.publish(out, make, INDEX if len(effects) > 1 else f"{effects[0].name}.html")
