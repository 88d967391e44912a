"""What a reproduction is, and how it runs from its arguments to its folder."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Generic, TypeVar

from matplotlib.figure import Figure

from ..errors import StudyError
from ..plots import png
from ..registry import nearest
from ..report import Picture
from ..report.html.folder import Contents, ReportFolder
from ..report.html.provenance import plain, versions

Progress = Callable[[str], None]
"""progress(what is being done)."""
Pictures = Mapping[str, tuple[Picture, ...]]
"""The pictures of a page, by the part of it that shows them."""
R = TypeVar("R")

_SCHEMA = "vcal-reproduce/"


def picture(name: str, figure: Figure, caption: str) -> Picture:
    """A picture of a page whose parts show theirs (`Pictures`)."""
    return Picture(name, "", caption, png(figure))


@dataclass(frozen=True)
class Row:
    """One published number and what came out here."""

    quantity: str
    seed: float | None
    """As published; None where the publication has no such number."""
    vcal: float
    unit: str
    note: str = ""


@dataclass(frozen=True)
class Reproduction(Generic[R]):
    """A published campaign that can be done again: what it computes, and how that is told."""

    name: str
    """As the command line takes it."""
    summary: str
    compute: Callable[[int, int, Progress], R]
    """compute(draws, seed, progress) -> its results."""
    table: Callable[[R], Sequence[Row]]
    pictures: Callable[[R], Pictures]
    record: Callable[[R], Mapping[str, Any]]
    page: Callable[[R, Sequence[Row], Pictures], str]
    counted: str
    """What is drawn: machines, tests, cycles."""
    draws: int
    """How many of them, unless another number is asked for."""
    least: int
    """How many it takes to have a spread."""

    def run(self, out: Path, draws: int, seed: int, progress: Progress) -> Path:
        """Compute everything and write page, record and pictures into `out`; returns the path of
        the page.

        Raises `StudyError` for a folder with other things in it, and for too few draws or a
        negative seed.
        """
        check_place(self.name, out)
        if draws < self.least or seed < 0:
            raise StudyError(
                f"found draws = {draws}, seed = {seed}, expected at least {self.least} draws, so "
                f"that the {self.counted} have a spread, and a seed of at least 0; correct them"
            )
        results = self.compute(draws, seed, progress)
        progress("drawing the pictures")
        rows, drawn = self.table(results), self.pictures(results)
        flat = [picture for group in drawn.values() for picture in group]
        return write(
            self.name, out, self.page(results, rows, drawn), rows, self.record(results), flat
        )


def known(name: str, reproductions: Mapping[str, Reproduction[Any]]) -> Reproduction[Any]:
    """The reproduction of that name; raises `StudyError` if there is none."""
    if name not in reproductions:
        raise StudyError(
            f"NAME: found {name!r}, expected one of {', '.join(reproductions)}"
            f"{nearest(name, reproductions)}; correct it"
        )
    return reproductions[name]


def check_place(name: str, out: Path | str) -> None:
    """Refuse a folder that the results must not be written to.

    Raises `StudyError` for a file, and for a folder with anything but results of this reproduction,
    as they were left.
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
    place = _place(name)

    def make(work: Path) -> Contents:
        record = {
            "schema": place.schema + "1",
            "name": name,
            "versions": versions(),
            "table": [vars(row) for row in table],
            **content,
        }
        return Contents(plain(record), {"index.html": page}, pictures)

    return place.publish(out, make)


def _place(name: str) -> ReportFolder:
    return ReportFolder(record="result.json", schema=f"{_SCHEMA}{name}/")
