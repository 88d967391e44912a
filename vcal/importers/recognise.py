"""Which format a file has."""

from collections.abc import Iterator

from ..errors import StudyError
from ..registry import nearest
from ..study.messages import listed, refusal
from .base import FORMATS, SURE, Format
from .export import Export

_LEAD = 0.2
"""How much surer than any other one a format has to be."""
_CLOSED = {
    "b5r": "a ball-bar record of Renishaw",
    "b20": "a ball-bar record of Renishaw",
    "rtl": "an interferometer record of Renishaw",
    "rta": "an interferometer record of Renishaw",
    "rts": "an interferometer record of Renishaw",
    "rtx": "an interferometer record of Renishaw",
    "pos": "a record of an interferometer or a controller",
    "xit": "a job of SpatialAnalyzer",
    "xit64": "a job of SpatialAnalyzer",
    "pwk": "a project of PolyWorks",
}
"""Files whose makers publish no description, by the ending of their names."""
_TABLES = ("xlsx", "xls", "ods", "parquet")


def recognised(export: Export, name: str | None) -> Format:
    """The format of a file: that of the given name, or the one that is surest of it.

    A given name does not concern a file with a mark of another format, such as a URDF file beside a
    table. Raises `StudyError` for an unknown name, for a file of no format, and for one of several.
    """
    if name is not None and name not in FORMATS:
        raise StudyError(
            f"--format: found {name!r}{nearest(name, FORMATS)}, expected one of {listed(FORMATS)}; "
            "correct the name"
        )
    export.data  # noqa: B018 - a missing file is reported first
    scores = dict(_scores(export))
    best = max(scores, key=lambda kind: scores[kind])
    if scores[best] == SURE or name is None:
        near = [kind for kind in scores if scores[kind] > scores[best] - _LEAD]
        if scores[best] > 0.0 and len(near) == 1:
            return FORMATS[best]()
        if name is None:
            raise _unknown(export) if scores[best] <= 0.0 else _ambiguous(export, near)
    return FORMATS[name]()


def _scores(export: Export) -> Iterator[tuple[str, float]]:
    for kind, cls in FORMATS.items():
        yield kind, cls().sniff(export)


def _ambiguous(export: Export, near: list[str]) -> StudyError:
    each = "; ".join(f"{kind} ({FORMATS[kind].summary})" for kind in near)
    return refusal(
        export.name,
        "format",
        f"a file that may be of several formats: {each}",
        "one of them",
        "give --format with its name",
    )


def _unknown(export: Export) -> StudyError:
    ending = export.path.suffix.removeprefix(".").casefold()
    if ending in _CLOSED:
        return refusal(
            export.name,
            "format",
            f"{_CLOSED[ending]}, of which its maker publishes no description",
            f"one of {listed(FORMATS)}",
            "export it as text or CSV from that program, and import this, or name its columns in "
            "[data.columns] of a study of your own",
        )
    if ending in _TABLES:
        return refusal(
            export.name,
            "format",
            "a spreadsheet",
            f"a text export of one of {listed(FORMATS)}",
            "save the sheet as CSV, or name its columns in [data.columns] of a study of your own",
        )
    if export.text is not None and export.attempted is None:
        export.table  # noqa: B018 - says what is wrong with it
    return refusal(
        export.name,
        "format",
        "a binary file" if export.text is None else "a table that no format recognises",
        f"one of {listed(FORMATS)}",
        "give --format with its name (vcal import --list describes the formats), or name its "
        "columns in [data.columns] of a study of your own",
    )
