"""`vcal import`: its options checked, and the list of formats."""

from collections.abc import Collection, Sequence
from pathlib import Path

from ..errors import StudyError
from ..importers import FORMATS, Options, import_study, summary
from ..importers.units import ANGLES_RAD, LENGTHS_MM, unit_of
from ..registry import nearest
from ..study.messages import listed
from .session import say


def run_import(
    files: Sequence[Path],
    out: Path | None,
    *,
    machine: str | None,
    tool_offset: str | None,
    positions: Path | None,
    format_name: str | None,
    unit: str | None,
    angle_unit: str | None,
    angles: str | None,
    axis: str | None,
    at: str | None,
    artefact: Path | None,
    contacts: int | None,
    time_format: str | None,
    overrides: Sequence[str],
    checked: bool,
    allow_outside: bool,
) -> list[str]:
    """Import files; returns the sentences to print. Raises `StudyError` for options that are
    missing or not understood.
    """
    if not files:
        raise StudyError(
            "FILE...: found none, expected the exports to import; name them, or list the formats "
            "with --list"
        )
    if out is None:
        raise StudyError("--out: found none, expected a folder for the study; give one")
    lengths, _, deviations = (unit or "").partition(",")
    options = Options(
        unit=_unit(lengths or None, LENGTHS_MM, "--unit"),
        deviation_unit=_unit(deviations or None, {**LENGTHS_MM, **ANGLES_RAD}, "--unit"),
        angle_unit=_unit(angle_unit, ANGLES_RAD, "--angle-unit"),
        angles=angles,
        time_format=time_format,
        positions=positions,
        axis=axis,
        at_mm=_places(at),
        artefact=artefact,
        contacts=contacts,
    )
    done = import_study(
        files,
        out,
        format_name=format_name,
        machine=machine,
        tool_offset=tool_offset,
        options=options,
        overrides=overrides,
        checked=checked,
        allow_outside=allow_outside,
    )
    return [*summary(done), f"Next: vcal check {out / 'setup.toml'}"]


def show_formats() -> None:
    """Print every format with what it needs, its source and what is not documented."""
    for name, kind in FORMATS.items():
        say(f"{name}: {kind.summary}")
        say(f"  needs: {kind.needs}")
        say(f"  source: {kind.source}")
        say(f"  not documented: {kind.undocumented}")


def _places(text: str | None) -> dict[str, float]:
    """Positions by axis from ``X=1,Y=2``."""
    found = {}
    for part in (text or "").replace(";", ",").split(","):
        axis, equals, value = part.partition("=")
        try:
            if equals:
                found[axis.strip().upper()] = float(value)
        except ValueError:
            equals = ""
        if part.strip() and not equals:
            raise StudyError(
                f"--at: found {part!r}, expected axes with positions, as in Y=300,Z=250; correct it"
            )
    return found


def _unit(text: str | None, known: Collection[str], option: str) -> str | None:
    if text is None:
        return None
    unit = unit_of(text)
    if unit not in known:
        raise StudyError(
            f"{option}: found {text!r}{nearest(text, known)}, expected one of {listed(known)}; "
            "correct it"
        )
    return unit
