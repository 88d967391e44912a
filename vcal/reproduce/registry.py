"""What a reproduction is, and how it runs from its arguments to its folder or a notebook."""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, wraps
from pathlib import Path
from typing import Any, Generic, TypeVar

from matplotlib.figure import Figure

from ..errors import StudyError
from ..registry import nearest
from ..report import Section, Table, Tile, sheet
from ..report.html.folder import Contents, ReportFolder
from ..report.html.provenance import plain, versions
from ..report.html.sheet import Fragment
from .document import Row, rows_table, section

Progress = Callable[[str], None]
"""progress(what is being done)."""
R = TypeVar("R")
K = TypeVar("K")
T = TypeVar("T")


@dataclass
class Computed:
    """What a reproduction computes: attributes made by `part`, each when it is first asked for."""

    draws: int
    seed: int = 0
    progress: Progress = lambda what: None


def part(what: str) -> Callable[[Callable[[Any], T]], "cached_property[T]"]:
    """A method of `Computed` as an attribute that is computed once; `what` is said when it is."""

    def said(method: Callable[[Any], T]) -> "cached_property[T]":
        @wraps(method)
        def once(self: Any) -> T:
            self.progress(what)
            return method(self)

        return cached_property(once)

    return said


def each(
    what: str, names: Iterable[Any]
) -> Callable[[Callable[[Any, K], T]], "cached_property[Lazy[K, T]]"]:
    """A method of `Computed` and a name as an attribute with the values of all `names`.

    `what`, with the name in its braces, is said when one is computed.
    """

    def said(method: Callable[[Any, K], T]) -> "cached_property[Lazy[K, T]]":
        def every(self: Any) -> Lazy[K, T]:
            def one(name: K) -> T:
                self.progress(what.format(name))
                return method(self, name)

            return Lazy(names, one)

        return cached_property(every)

    return said


class Lazy(Mapping[K, T]):
    """Values by name, each computed when it is first asked for."""

    def __init__(self, names: Iterable[K], compute: Callable[[K], T]):
        self._names, self._compute, self._found = tuple(names), compute, dict[K, T]()

    def __getitem__(self, name: K) -> T:
        if name not in self._names:
            raise KeyError(name)
        if name not in self._found:
            self._found[name] = self._compute(name)
        return self._found[name]

    def __iter__(self) -> Iterator[K]:
        return iter(self._names)

    def __len__(self) -> int:
        return len(self._names)


@dataclass(frozen=True)
class Reproduction(Generic[R]):
    """A published campaign that can be done again: what it computes, and how that is described."""

    name: str
    """As the command line takes it."""
    summary: str
    title: str
    publication: str
    compute: Callable[..., R]
    """compute(draws, seed, progress, **effort) -> everything, computed when it is asked for."""
    rows: Callable[[R], Sequence[Row]]
    """Published numbers beside those that came out."""
    record: Callable[[R], Mapping[str, Any]]
    """What `result.json` holds besides the rows."""
    head: Callable[[R], tuple[str, Sequence[Tile]]]
    """The summary of the page and its key figures."""
    texts: Mapping[str, Callable[[R], str]]
    """Sections by their titles, as `document.section` reads them."""
    shown: Mapping[str, Callable[[R], Table | Figure]]
    """Tables and pictures by name."""
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
        """Results, computed when asked for; `effort` is what the reproduction lets one shorten.

        Raises `StudyError` for too few draws and for a negative seed.
        """
        draws = self.draws if draws is None else draws
        if draws < self.least or seed < 0:
            raise StudyError(
                f"found draws = {draws}, seed = {seed}, expected at least {self.least} draws, so "
                f"that the {self.counted} have a spread, and a seed of at least 0; correct them"
            )
        return Results(self, draws, seed, self.compute(draws, seed, progress, **effort))

    def run(
        self,
        out: Path,
        draws: int,
        seed: int,
        progress: Progress,
        computed: Callable[[str], None] = lambda summary: None,
    ) -> Path:
        """Compute everything and write page, record and pictures into `out`, all or none of them;
        returns the path of the page. `computed` gets the summary before anything is written.

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
        computed(found.summary)
        return place.publish(out, lambda work: Contents(record, texts, pictures))


@dataclass(frozen=True)
class Results(Generic[R]):
    """The results of a reproduction with their tables and pictures; a notebook shows them all, or
    some of them and has no others computed.
    """

    of: Reproduction[R]
    draws: int
    seed: int
    values: R
    """As they are computed, each when it is first asked for."""

    @cached_property
    def rows(self) -> Sequence[Row]:
        """Published numbers beside those that came out."""
        return self.of.rows(self.values)

    def shown(self, name: str) -> Table | Figure:
        """A table or a picture; raises `KeyError` if there is none of that name."""
        return rows_table(self.rows) if name == "numbers" else self.of.shown[name](self.values)

    @cached_property
    def sections(self) -> list[Section]:
        """The sections of the page."""
        return [
            section(title, text(self.values), self.shown) for title, text in self.of.texts.items()
        ]

    def section(self, title: str) -> Fragment:
        """One section, shown by a notebook; raises `KeyError` if there is none of that title."""
        return Fragment((section(title, self.of.texts[title](self.values), self.shown),))

    def show(self, *names: str) -> Fragment:
        """Some tables and pictures, shown by a notebook without the text of their sections.

        Raises `KeyError` if there is none of that name.
        """
        return Fragment(tuple(section("", f":{name}", self.shown) for name in names))

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

    @property
    def summary(self) -> str:
        """The main results in a few sentences."""
        return " ".join(self.of.head(self.values)[0].split())

    def html(self) -> str:
        """The page as one self-contained HTML text."""
        return sheet(
            self.of.title,
            self.summary,
            self.sections,
            kicker=f"vcal reproduce {self.of.name}",
            facts=[
                ("publication", self.of.publication),
                (self.of.counted, f"{self.draws}, each one identified; seed {self.seed}"),
            ],
            tiles=self.of.head(self.values)[1],
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
