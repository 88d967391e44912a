"""What a reproduction is, and how it runs from its arguments to its folder or a notebook."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any, Generic, TypeVar

from ..errors import StudyError
from ..registry import nearest
from ..report import Section, sheet
from ..report.html.folder import Contents, ReportFolder
from ..report.html.provenance import plain, versions
from ..report.html.sheet import Fragment
from .document import Page, Row, rows_table

Progress = Callable[[str], None]
"""progress(what is being done)."""
R = TypeVar("R")


@dataclass(frozen=True)
class Reproduction(Generic[R]):
    """A published campaign that can be done again: what it computes, and how that is described."""

    name: str
    """As the command line takes it."""
    summary: str
    title: str
    publication: str
    compute: Callable[..., R]
    """compute(draws, seed, progress, **effort) -> everything that is computed."""
    rows: Callable[[R], Sequence[Row]]
    """Published numbers beside those that came out."""
    record: Callable[[R], Mapping[str, Any]]
    """What `result.json` holds besides the rows."""
    page: Callable[[R], Page]
    counted: str
    """What is drawn: machines, tests, cycles."""
    draws: int
    """How many of them, unless another number is asked for."""
    least: int
    """How many it takes to have a spread."""

    def results(
        self,
        draws: int | None = None,
        seed: int = 0,
        progress: Progress = lambda what: None,
        **effort: Any,
    ) -> "Results[R]":
        """Compute everything; `effort` is what the reproduction lets one shorten besides.

        Raises `StudyError` for too few draws and for a negative seed.
        """
        draws = self.draws if draws is None else draws
        if draws < self.least or seed < 0:
            raise StudyError(
                f"found draws = {draws}, seed = {seed}, expected at least {self.least} draws, so "
                f"that the {self.counted} have a spread, and a seed of at least 0; correct them"
            )
        return Results(self, draws, seed, self.compute(draws, seed, progress, **effort))

    def run(self, out: Path, draws: int, seed: int, progress: Progress) -> Path:
        """Compute everything and write page, record and pictures into `out`, all or none of them;
        returns the path of the page.

        Raises `StudyError` as `results` does, for a file, and for a folder with anything but
        results of this reproduction, as they were left.
        """
        place = ReportFolder(record="result.json", schema=f"vcal-reproduce/{self.name}/")
        place.check(out)
        found = self.results(draws, seed, progress)
        progress("drawing the pictures")
        pictures = [picture for section in found.sections for picture in section.pictures]
        record = {"schema": place.schema + "1", **found.record()}
        texts = {"index.html": found.html()}
        return place.publish(out, lambda work: Contents(record, texts, pictures))


@dataclass(frozen=True)
class Results(Generic[R]):
    """The results of a reproduction with their tables and pictures; a notebook shows them all."""

    of: Reproduction[R]
    draws: int
    seed: int
    values: R
    """As they were computed."""

    @cached_property
    def rows(self) -> Sequence[Row]:
        """Published numbers beside those that came out."""
        return self.of.rows(self.values)

    @cached_property
    def page(self) -> Page:
        """The description of the page."""
        described = self.of.page(self.values)
        return replace(described, tables={**described.tables, "numbers": rows_table(self.rows)})

    @cached_property
    def sections(self) -> list[Section]:
        """The sections of the page."""
        return self.page.sections()

    def section(self, title: str) -> Fragment:
        """One section, shown by a notebook; raises `KeyError` if there is none of that title."""
        return Fragment(({s.title: s for s in self.sections}[title],))

    def record(self) -> dict[str, Any]:
        """All numbers in the types of JSON: what `result.json` holds."""
        table = [
            {"quantity": row.quantity, "seed": row.published, "vcal": row.vcal, "unit": row.unit,
             "note": row.note}
            for row in self.rows
        ]  # fmt: skip
        return plain(
            {
                "name": self.of.name,
                "versions": versions(),
                "table": table,
                "seed": self.seed,
                "draws": self.draws,
                **self.of.record(self.values),
            }
        )

    def html(self) -> str:
        """The page as one self-contained HTML text."""
        return sheet(
            self.of.title,
            self.page.summary,
            self.sections,
            kicker=f"vcal reproduce {self.of.name}",
            facts=[
                ("publication", self.of.publication),
                (self.of.counted, f"{self.draws}, each one identified; seed {self.seed}"),
            ],
            tiles=self.page.tiles,
        )

    def _repr_html_(self) -> str:
        return Fragment(tuple(self.sections))._repr_html_()


def known(name: str, reproductions: Mapping[str, Reproduction[Any]]) -> Reproduction[Any]:
    """The reproduction of that name; raises `StudyError` if there is none."""
    if name not in reproductions:
        raise StudyError(
            f"NAME: found {name!r}, expected one of {', '.join(reproductions)}"
            f"{nearest(name, reproductions)}; correct it"
        )
    return reproductions[name]
