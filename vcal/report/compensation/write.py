"""Writing the files of a compensation, all of them or none."""

from collections.abc import Iterable
from pathlib import Path
from typing import Any

from ...compensation import Compensation, Kept
from ...study.messages import refusal
from ..html.folder import Contents, ReportFolder
from ..html.provenance import plain, versions

COMPENSATION_SCHEMA = "vcal-compensation/1"
RECORD = "compensation.json"


def _folder() -> ReportFolder:
    return ReportFolder(RECORD, "vcal-compensation/")


def check_compensation_folder(out: Path | str, reads: Iterable[Path] = ()) -> None:
    """Check that a compensation may be written to `out`, which must not hold what is read.

    Raises `StudyError` as `ReportFolder.check` does, and for the folder of the report itself.
    """
    out = Path(out)
    if any(out.resolve() == path.resolve() for path in reads):
        raise refusal(
            str(out),
            "output folder",
            "the folder that is read",
            "a folder of its own",
            "choose another",
        )
    _folder().check(out)


def write_compensation(found: Compensation, out: Path | str, *, command: str = "") -> list[str]:
    """Write the files of a compensation with ``compensation.json``, which states what they carry;
    returns their names. Raises `StudyError` as `check_compensation_folder` does.
    """
    texts = dict(found.files)
    record = compensation_record(found) | {"command": command}
    _folder().publish(out, lambda work: Contents(plain(record), texts), page=RECORD)
    return [*texts, RECORD]


def compensation_record(found: Compensation) -> dict[str, Any]:
    """What a compensation carries, and what stays, for programs."""
    form = found.format
    return {
        "schema": COMPENSATION_SCHEMA,
        "format": form.name,
        "source": form.source,
        "sign": form.sign,
        "units": form.units,
        "resolution": form.resolution,
        "limits": form.limits,
        "options": found.options.model_dump(),
        "machine": found.machine.chain.text,
        "name": found.machine.name,
        "carried": [_kept(part) for part in found.carried],
        "not_carried": [_kept(part) for part in found.not_carried],
        "not_identified": list(found.not_identified),
        "versions": versions(),
    }


def _kept(part: Kept) -> dict[str, Any]:
    return {
        "name": part.name,
        "rms_um": part.rms_um,
        "largest_um": part.largest_um,
        "stays_rms_um": part.stays_rms_um,
        "stays_largest_um": part.stays_largest_um,
        "reason": part.reason,
    }
