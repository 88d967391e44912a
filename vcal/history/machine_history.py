"""The history of a machine: the series of its reports, and what has changed."""

import datetime
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ..words import counted
from .changes import Outcome, outcomes
from .reports import Report, check_points, read_reports
from .series import Entry, all_series, scalar

ALPHA = 0.05
"""Default probability that any change is found where nothing has changed."""
_MOVED = 1e-6
"""Largest difference of two positions of a check point that is the same, m or rad."""


@dataclass(frozen=True)
class History:
    """The reports of one machine, and every series with its tests."""

    reports: tuple[Report, ...]
    outcomes: tuple[Outcome, ...]
    alpha: float
    """Probability that any change is found where nothing has changed."""
    notes: tuple[str, ...]

    @property
    def machine(self) -> str:
        """The chain of the machine."""
        return str(self.reports[0].record["machine"])

    @property
    def serial_number(self) -> str:
        """Serial number, where a report states it."""
        return next((one.serial_number for one in self.reports if one.serial_number), "")

    @property
    def tested(self) -> list[Outcome]:
        """Series with at least two dates."""
        return [one for one in self.outcomes if one.tested is not None]

    @property
    def changed(self) -> list[Outcome]:
        """Series with a significant change."""
        return [one for one in self.outcomes if one.changes]

    @property
    def appeared(self) -> list[Outcome]:
        """Effects that have appeared or disappeared."""
        return [one for one in self.outcomes if one.appearances]

    @property
    def recent(self) -> list[Outcome]:
        """Series whose last result differs significantly from the one before."""
        return [
            one
            for one in self.outcomes
            if one.since is not None and one.since.corrected <= self.alpha
        ]

    @property
    def tests(self) -> int:
        """Number of all tests: places of a step, and drifts."""
        return sum(len(one.tested.alternatives) for one in self.tested if one.tested)

    @property
    def effective(self) -> float:
        """Effective number of all tests."""
        return sum(one.tested.effective for one in self.tested if one.tested)


def read_history(
    folder: Path | str,
    dates: Mapping[str, datetime.date] | None = None,
    *,
    written: bool = False,
    alpha: float = ALPHA,
    seed: int = 0,
) -> History:
    """The history of the machine whose reports lie below `folder`.

    `dates` are dates of measurement by the folder of the report (`read_dates`); with `written`, the
    day on which a report was written stands for a date that is not stated. `alpha` is the
    probability that any change is found where nothing has changed, `seed` that of the draws behind
    effective numbers of tests. Raises `StudyError` as `read_reports` does.
    """
    reports = read_reports(folder, dates, written=written)
    notes = _notes(reports)
    volumetric, refused = _volumetric(reports)
    found = outcomes(all_series(reports, volumetric), [r.date for r in reports], alpha, seed)
    return History(tuple(reports), tuple(found), alpha, (*notes, *refused))


def _volumetric(reports: Sequence[Report]) -> tuple[dict[str, list[Entry]], list[str]]:
    """The volumetric error of every machine before compensation, as its report states it: rms and
    largest; none, and a note, where the working volumes are not the same.
    """
    volumes = [
        [(one["axis"], round(one["low"], 6), round(one["high"], 6)) for one in volume]
        for volume in (report.record["working_volume"] for report in reports)
    ]
    if any(volume != volumes[0] for volume in volumes):
        return {}, [
            "The reports state the volumetric error in different working volumes, so that it is no "
            "series."
        ]
    stated = [report.content.get("volumetric_error", {}).get("before", {}) for report in reports]
    return {
        name: [
            scalar(one.get(f"{name}_um"), one.get(f"{name}_standard_uncertainty_um"))
            for one in stated
        ]
        for name in ("rms", "largest")
    }, []


def _notes(reports: Sequence[Report]) -> list[str]:
    """What a reader has to know beside the tests."""
    found = []
    if len(reports) == 1:
        found.append("There is one report only, so that nothing could be tested.")
    early = [one.folder for one in reports if one.content["interrupted"]]
    if early:
        found.append(f"The search was interrupted in {', '.join(early)}.")
    if moved := _other_check_points(reports):
        found.append(
            f"The check points of {', '.join(moved)} are not those of {reports[0].folder}, so that "
            "a change of the error at the check points may be one of the points."
        )
    offsets = {tuple(np.round(one.record["tool_offset_mm"], 3)) for one in reports}
    if len(offsets) > 1:
        found.append(
            f"The tool point has {counted(len(offsets), 'place')} relative to the spindle: "
            "deviations that it sees with a lever differ for this reason alone."
        )
    return found


def _other_check_points(reports: Sequence[Report]) -> list[str]:
    """Folders of reports whose check points differ from those of the first that has some."""
    found = [
        (one.folder, position) for one in reports if (position := check_points(one)) is not None
    ]
    return [
        name
        for name, position in found[1:]
        if position.shape != found[0][1].shape or abs(position - found[0][1]).max() > _MOVED
    ]
