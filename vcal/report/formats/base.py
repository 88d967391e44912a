"""What an output format is, and the registry of all formats."""

import csv
import io
import math
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

from ...geometry.acceptance import GeometricTest
from ...geometry.error_motions import ErrorMotionTable
from ...loop.outcome.closure import Closure
from ...registry import Catalogue
from ...study.study import Study


@dataclass(frozen=True)
class Results:
    """The results of a closed loop that a format can state."""

    closure: Closure
    study: Study
    motions: Sequence[ErrorMotionTable]
    """Error motions and location errors of the identified machine."""
    deviations: Sequence[GeometricTest]
    """Its geometric deviations as ISO 230-1 defines them."""
    anyway: bool = False
    """Whether a compensation is stated even where it does not reduce the error."""


class Format(ABC):
    """A file of a report, which another program or a control reads.

    A new format is a class in a file of its own in this folder, decorated with
    ``FORMATS.register``. Its docstring states source, sign rule and units.
    """

    file: ClassVar[str]
    """Name of the file in the folder of the report."""
    summary: ClassVar[str]
    """Its content in one line, for the page."""

    @abstractmethod
    def text(self, results: Results) -> str | None:
        """The content of the file; None where these results have none."""


FORMATS: Catalogue[type[Format]] = Catalogue("output format", attribute="file")
"""All formats by the names of their files; every report holds all that apply."""


def number(value: float) -> str:
    """Eight significant digits; empty for a number that is not finite."""
    return f"{value:.8g}" if math.isfinite(value) else ""


def csv_text(rows: Sequence[Sequence[str]]) -> str:
    """Rows as CSV."""
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerows(rows)
    return text.getvalue()
