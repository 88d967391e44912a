"""What a reproduction is, and how its folder is written."""

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ..catalogue import nearest
from ..errors import StudyError
from ..report import Picture
from ..report.place import Place
from ..report.record import plain, versions

Progress = Callable[[str], None]
"""progress(what is being done)."""
Run = Callable[[Path, int, int, Progress], Path]
"""run(out, draws, seed, progress) -> its page."""

_SCHEMA = "vcal-reproduce/"


@dataclass(frozen=True)
class Reproduction:
    """A published campaign that can be done again."""

    name: str
    """As the command line takes it."""
    summary: str
    run: Run
    """Writes page, record and pictures into a folder."""
    draws: int
    """Tests, unless another number is asked for."""


@dataclass(frozen=True)
class Row:
    """One published number and what came out here."""

    quantity: str
    seed: float | None
    """As published; None where the publication has no such number."""
    vcal: float
    unit: str
    note: str = ""


def known(name: str, reproductions: Mapping[str, Reproduction]) -> Reproduction:
    """The reproduction of that name; raises `StudyError` if there is none."""
    if name not in reproductions:
        raise StudyError(
            f"NAME: found {name!r}, expected one of {', '.join(reproductions)}"
            f"{nearest(name, reproductions)}; correct it"
        )
    return reproductions[name]


def check_place(name: str, out: Path | str) -> None:
    """Refuse a folder that the results must not be written to.

    Raises `StudyError` for a file, and for a folder with anything but results of this reproduction.
    """
    _place(name).check(Path(out))


def write(
    name: str,
    out: Path | str,
    page: str,
    table: Sequence[Row],
    content: Mapping[str, Any],
    pictures: Sequence[Picture],
) -> Path:
    """Write `index.html`, `result.json` and the pictures into `out`, all or none of them.

    `result.json` holds `content` besides the table (`quantity`, `seed`, `vcal`, `unit`, `note`).
    Returns the path of the page. Raises as `check_place` does.
    """
    out = Path(out)
    place = _place(name)

    def make(work: Path) -> Sequence[str]:
        files = [*(picture.file for picture in pictures), "index.html", place.record]
        for picture in pictures:
            (work / picture.file).write_bytes(picture.data)
        (work / "index.html").write_text(page, encoding="utf-8")
        record = {
            "schema": place.schema + "1",
            "name": name,
            "versions": versions(),
            "table": [vars(row) for row in table],
            **content,
            "files": files,
        }
        text = json.dumps(plain(record), indent=1, allow_nan=False, ensure_ascii=False)
        (work / place.record).write_text(text + "\n", encoding="utf-8")
        return files

    place.fill(out, make)
    return out / "index.html"


def _place(name: str) -> Place:
    return Place(record="result.json", schema=f"{_SCHEMA}{name}/")
