"""The page and the record of many studies."""

import datetime
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from ..report.html import text
from ..report.html.folder import Contents, ReportFolder
from ..report.html.provenance import plain, versions
from ..report.html.sheet import Badge, Section, Table, Tile, sheet
from ..words import counted
from .jobs import REPORTS
from .one_study import Member

SCHEMA = "vcal-fleet/1"
_FOLDER = ReportFolder("fleet.json", "vcal-fleet/", beside=REPORTS, live=True)
_WORDS = {
    "closed": "closed now", "up to date": "kept: up to date", "refused": "cannot be used",
    "failed": "failed", "lost": "lost its process", "not begun": "not begun",
}  # fmt: skip
_VERDICTS = {
    "nothing_missing": "nothing was found", "named": "named", "ambiguous": "ambiguous",
    "unexplained": "unexplained",
}  # fmt: skip
_STAGES = {"uncompensated": "error", "before": "declared model", "after": "identified"}
"""The stages of a report, and the heads of their columns."""
_ORDER = ("failed", "lost", "refused", "not begun")
"""The ways to end without a report, in the order of the page."""


def write_index(
    members: Sequence[Member], out: Path | str, *, command: str = "", interrupted: bool = False
) -> Path:
    """Write the page and the record of many studies into `out`; returns the path of the page.

    Raises `StudyError` for a folder with other content.
    """

    def make(work: Path) -> Contents:
        content = record(members, command=command, interrupted=interrupted)
        shown = _page(members, command, interrupted)
        return Contents(content, {"index.html": shown})

    return _FOLDER.publish(out, make)


def record(
    members: Sequence[Member], *, command: str = "", interrupted: bool = False
) -> dict[str, Any]:
    """The content of ``fleet.json``, as plain values: a summary of every study.

    ``errors_um`` holds the rms errors of the three stages, at the check points or else of the
    held-out readings. Keys of a study without a report are None.
    """
    return plain(
        {
            "schema": SCHEMA,
            "sentence": _sentence(members, interrupted),
            "interrupted": interrupted,
            "studies": [_member(one) for one in members],
            "versions": versions(),
            "written": datetime.datetime.now().isoformat(timespec="seconds"),
            "command": command,
        }
    )


def _member(one: Member) -> dict[str, Any]:
    basis, errors = errors_of(one.content)
    return {
        "name": one.job.name,
        "setup": str(one.job.setup),
        "report": f"{REPORTS}/{one.job.name}/index.html" if one.done else None,
        "status": one.status,
        "message": one.message or None,
        "trace": one.trace or None,
        "verdict": one.content.get("verdict"),
        "sentence": one.content.get("sentence"),
        "found": [_name(e) for e in one.content.get("effects", []) if e["found"]],
        "errors_are": basis or None,
        "errors_um": {stage: value for stage, (value, _) in errors.items()} or None,
        "u_errors_um": {stage: u for stage, (_, u) in errors.items()} or None,
        "acceptance": one.content.get("acceptance", {}).get("sentence"),
        "seconds": one.seconds,
    }


def errors_of(content: Mapping[str, Any]) -> tuple[str, dict[str, tuple[float, float | None]]]:
    """What the errors of a report are (``"check points"`` or ``"held-out readings"``), and the rms
    error with its standard uncertainty of every stage, um.
    """
    stages = content.get("errors", {})
    for key, basis in (("check", "check points"), ("heldout", "held-out readings")):
        found = {
            stage: (its[f"{key}_rms_um"], its.get(f"u_{key}_rms_um"))
            for stage, its in stages.items()
            if its.get(f"{key}_rms_um") is not None
        }
        if found and found.keys() == stages.keys():
            return basis, found
    return "", {}


def _name(effect: Mapping[str, Any]) -> str:
    return f"{effect['effect']} {effect['placement']}".strip()


def _sentence(members: Sequence[Member], interrupted: bool) -> str:
    done = [one for one in members if one.done]
    said = f"{len(done)} of {counted(len(members), 'study', 'studies')} have a report"
    rest = [
        f"{len(its)} {_WORDS[status]}"
        for status in _ORDER
        if (its := [one for one in members if one.status == status])
    ]
    said += f": {', '.join(rest)}." if rest else "."
    if interrupted:
        said += " The command was interrupted; repeat it to go on."
    return said


def _page(members: Sequence[Member], command: str, interrupted: bool) -> str:
    done = [one for one in members if one.done]
    bad = [one for one in members if one.status in _ORDER]
    found = [one for one in done if one.content["verdict"] not in ("nothing_missing", None)]
    worse = [one for one in done if one.content.get("no_gain")]
    tiles = [
        Tile("Studies with a report", f"{len(done)} of {len(members)}"),
        Tile("Studies with a missing effect", str(len(found))),
        Tile("Studies that compensation does not improve", str(len(worse))),
    ]
    badge = Badge("Not complete", "caution") if bad else Badge("Complete", "good")
    rows = [(f"vcal {k}" if k == "vcal" else k, v) for k, v in versions().items()]
    provenance = Section(
        "Provenance",
        tables=(
            Table(("", ""), [*([("command", command)] if command else []), *rows,
                             ("written", datetime.datetime.now().strftime("%Y-%m-%d %H:%M"))]),
        ),
    )  # fmt: skip
    return sheet(
        counted(len(members), "study", "studies"),
        _sentence(members, interrupted),
        [*_without_report(bad), _with_report(done), provenance],
        kicker="vcal – many studies",
        badge=badge,
        tiles=tiles,
    )


def _without_report(bad: Sequence[Member]) -> list[Section]:
    if not bad:
        return []
    rows = [
        (one.job.name, _WORDS[one.status], one.message or "repeat the command")
        for status in _ORDER
        for one in bad
        if one.status == status
    ]
    return [Section("Without a report", tables=(Table(("study", "state", "why"), rows, "lll"),))]


def _with_report(done: Sequence[Member]) -> Section:
    links = {one.job.name: f"{REPORTS}/{one.job.name}/index.html" for one in done}
    header = (
        "study", "verdict", "found", *(f"{words}, µm" for words in _STAGES.values()),
        "errors are of", "what to do", "report",
    )  # fmt: skip
    table = Table(
        header, [_row(one) for one in done], "lllrrrlll", links=links, sortable=True,
        note="Errors are rms deviations ± standard uncertainty: of the machine as it is, of the "
        "model without and of that with what was found. A click on the head of a column sorts the "
        "rows.",
    )  # fmt: skip
    return Section("Reports", tables=(table,))


def _row(one: Member) -> tuple[str, ...]:
    content = one.content
    basis, errors = errors_of(content)
    values = [
        text.with_uncertainty(*errors[stage]) if stage in errors else text.DASH for stage in _STAGES
    ]
    found = [e for e in content["effects"] if e["found"]]
    names = ", ".join(map(_name, found)) or text.DASH
    verdict = _VERDICTS.get(content["verdict"], "interrupted")
    return (
        one.job.name, verdict, names, *values, basis or text.DASH, _advice(content),
        _WORDS[one.status],
    )  # fmt: skip


def _advice(content: Mapping[str, Any]) -> str:
    """What to do next, in a few words."""
    if content.get("interrupted"):
        return "repeat the command: the search was interrupted"
    if (content.get("declared_sizes") or {}).get("gross"):
        return "correct the declaration of the machine"
    if content.get("no_gain"):
        return "do not compensate: it does not reduce the error"
    if content["verdict"] == "unexplained":
        return "look at the residuals: a part has no name"
    if content["verdict"] == "ambiguous":
        return "decide between the names: the report says how"
    return "compensate"
