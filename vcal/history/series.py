"""Series of results over reports: geometric deviations, effects, volumetric and check-point errors.

Every series has one entry for each report: values with their covariance, or the reason why this
report has none.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from jaxtyping import Float

from ..compensation.parts import GEOMETRY
from ..identification.fit import POORLY_DETERMINED
from .change_points import Sample, Size
from .reports import Report

Group = Literal[
    "squareness and location",
    "straightness",
    "positioning",
    "angular errors",
    "effects",
    "thermal effects",
    "volumetric error",
    "check points",
]
State = Literal[
    "measured",
    "declared",
    "named",
    "ambiguous",
    "not named",
    "cannot be seen",
    "not searched for",
    "not determined",
    "not stated",
]
TESTED: tuple[State, ...] = ("measured", "declared", "named")
"""States of entries whose values are tested."""
_OF_GEOMETRY = frozenset(kind.name for kind in GEOMETRY)
_GROUPS: Mapping[str, Group] = {
    "positioning": "positioning",
    "straightness": "straightness",
    "angular error": "angular errors",
}


@dataclass(frozen=True)
class Part:
    """One quantity of a series."""

    name: str
    """Name of a parameter; empty where the series has one quantity only."""
    unit: str


@dataclass(frozen=True)
class Entry:
    """What one report says about a series."""

    state: State
    size: Size | None = None
    smallest: tuple[float | None, ...] = ()
    """Of an effect that is not named: the smallest size of each part that would have been named
    with a probability of 95 %; None where none is known."""

    @property
    def tested(self) -> bool:
        """Whether the values are tested for changes."""
        return self.state in TESTED


@dataclass(frozen=True)
class Series:
    """Results of the same quantities in all reports, in the order of their dates."""

    name: str
    group: Group
    parts: tuple[Part, ...]
    entries: tuple[Entry, ...]

    @property
    def tested(self) -> list[int]:
        """The reports whose entries are tested, by their numbers."""
        return [i for i, entry in enumerate(self.entries) if entry.tested]

    def sample(self, days: Float[np.ndarray, " n"]) -> Sample:
        """The entries that are tested; `days` are the dates of all reports."""
        mine = self.tested
        found = [size for i in mine if (size := self.entries[i].size) is not None]
        values, covariances = [one.value for one in found], [one.covariance for one in found]
        return Sample(np.asarray(days)[mine], np.array(values), np.array(covariances))


def all_series(
    reports: Sequence[Report], volumetric: Mapping[str, Sequence[Entry]]
) -> list[Series]:
    """All series of some reports; `volumetric` holds the entries of the volumetric error before
    compensation, by statistic.

    Series in which no report has values are left out.
    """
    found = [
        *_deviations(reports),
        *_effects(reports),
        *(
            Series(f"volumetric error, {name}", "volumetric error", (Part("", "um"),), (*entries,))
            for name, entries in volumetric.items()
        ),
        *_check_points(reports),
    ]
    return [one for one in found if one.tested]


def scalar(value: float | None, u: float | None, information: float | None = 1.0) -> Entry:
    """The entry of one value; without one, or without an uncertainty, it is not stated."""
    if information is not None and information < POORLY_DETERMINED:
        return Entry("not determined")
    if value is None or not u:
        return Entry("not stated")
    return Entry("measured", Size(np.array([value]), np.array([[u * u]])))


def _deviations(reports: Sequence[Report]) -> Iterator[Series]:
    """Deviations by ISO 230-1."""
    found: dict[tuple[str, str], dict[int, Mapping[str, Any]]] = {}
    for i, report in enumerate(reports):
        for one in report.content["geometry"]:
            found.setdefault((one["name"], one["what"]), {})[i] = one
    for (name, what), by_report in found.items():
        unit = next(iter(by_report.values()))["unit"]
        entries = [
            scalar(one["value"], one["standard_uncertainty"], one["information_share"])
            if (one := by_report.get(i)) is not None
            else Entry("not stated")
            for i in range(len(reports))
        ]
        group = _GROUPS.get(what.partition(",")[0], "squareness and location")
        yield Series(f"{name}: {what}", group, (Part("", unit),), tuple(entries))


def _check_points(reports: Sequence[Report]) -> Iterator[Series]:
    stages = {"uncompensated": "before compensation", "after": "after compensation"}
    for stage, words in stages.items():
        errors = [report.content["errors"][stage] for report in reports]
        entries = [scalar(one["check_rms_um"], one["u_check_rms_um"]) for one in errors]
        name = f"check points, rms {words}"
        yield Series(name, "check points", (Part("", "um"),), tuple(entries))


def _effects(reports: Sequence[Report]) -> Iterator[Series]:
    """Effects of the machine that some report has in its model, other than its geometry."""
    found: dict[tuple[str, tuple[Part, ...]], dict[int, Size]] = {}
    for i, report in enumerate(reports):
        for key, (parts, size) in _parameters(report.record).items():
            found.setdefault((key, parts), {})[i] = size
    names = [key for key, _ in found]
    for (key, parts), by_report in found.items():
        entries = tuple(
            _entry(report.content, key, parts, by_report.get(i)) for i, report in enumerate(reports)
        )
        same = f" ({', '.join(p.name for p in parts)})" if names.count(key) > 1 else ""
        thermal = any("K" in part.unit for part in parts)
        group: Group = "thermal effects" if thermal else "effects"
        yield Series(f"{key}{same}", group, parts, entries)


def _parameters(record: Mapping[str, Any]) -> dict[str, tuple[tuple[Part, ...], Size]]:
    """Parameters of every effect of a machine, with their values and covariance."""
    places: dict[str, list[int]] = {}
    for i, one in enumerate(record["parameters"]):
        if one["effect"].split()[0] not in _OF_GEOMETRY:
            places.setdefault(one["effect"], []).append(i)
    found = {}
    for key, mine in places.items():
        listed = [record["parameters"][i] for i in mine]
        parts = tuple(Part(one["parameter"], one["unit"]) for one in listed)
        rows = record["covariance"]
        covariance = np.array([[rows[max(i, j)][min(i, j)] for j in mine] for i in mine])
        found[key] = parts, Size(np.array([one["value"] for one in listed]), covariance)
    return found


def _entry(
    content: Mapping[str, Any],
    key: str,
    parts: tuple[Part, ...],
    known: Size | None,
) -> Entry:
    """What a report says about an effect."""
    if known is not None:
        return Entry(_state(content, key) if _definite(known.covariance) else "not stated", known)
    effect = key.split()[0]
    if any(_key(one) == key for one in content.get("cannot_be_seen", [])):
        return Entry("cannot be seen")
    untestable = any(_key(one) == key for one in content["untestable"])
    if effect not in content["settings"]["effects"] or untestable or content["interrupted"]:
        return Entry("not searched for")
    limits: dict[str, float] = {}
    for one in content.get("smallest_sizes", []):
        if _key(one) == key and one["size"] is not None:
            name = one["parameter"]  # of several instances of the effect
            limits[name] = min(one["size"], limits.get(name, one["size"]))
    return Entry("not named", smallest=tuple(limits.get(part.name) for part in parts))


def _definite(covariance: np.ndarray) -> bool:
    """Whether no parameter, and no combination of them, is known exactly."""
    u = np.sqrt(np.diag(covariance))
    if not (u > 0.0).all():
        return False
    least = np.linalg.eigvalsh(covariance / np.outer(u, u))[0]
    return bool(least > len(u) * np.finfo(float).eps)


def _state(content: Mapping[str, Any], key: str) -> State:
    for one in content["effects"]:
        if f"{one['effect']} {one['fitted_placement']}".strip() == key:
            return "named" if one["found"] and one["status"] == "named" else "ambiguous"
    return "declared"


def _key(one: Mapping[str, Any]) -> str:
    return f"{one['effect']} {one['placement']}".strip()
