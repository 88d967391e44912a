"""Logs of a machine's own probe: the axis positions at every contact."""

import re
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from ...instruments.conditions import LINEAR, ROTARY, file_column
from ...study.messages import listed, refusal
from ..base import LIKELY, NO, POSSIBLE, SURE, DataSet, Format, Machine, Needs, Options, register
from ..columns import names_of, places
from ..export import Export, number
from ..points import Units
from ..units import ANGLES_RAD
from .laser_tracker import MACHINE

_NINE = "XYZABCUVW"
_GRBL = re.compile(r"\[PRB:([^:\]]*):([01])\]")
_WORD = re.compile(r"([XYZABCUVW])\s*([-+]?\d*\.?\d+)")
_FOUND_MM = 1e-13
_STEPS = 50
_KEYS = {"probe_sigma_um": "repeatability of the probe, one standard deviation, um"}
_SIZES = {
    "artefact": "what was touched: sphere or ring; for a step gauge or an array of balls, give the "
    "table of its faces or centres as --artefact instead",
    "diameter_mm": "calibrated diameter of the sphere or ring, mm",
    "stylus_radius_mm": "effective radius of the stylus tip, mm; 0 where the control corrected it",
}
_OWN = re.compile(r"setup|run|face|approach|dir_[a-cu-z]|t_s|T_\w+_degC")
"""Columns of a table that have vcal's own names."""


@register
class ProbeLog(Format):
    """Axis positions at the contacts of a touch probe, one per line:

    - LinuxCNC, between ``(PROBEOPEN file)`` and ``(PROBECLOSE)``: nine numbers, the positions of X,
      Y, Z, A, B, C, U, V, W at each successful straight probe (G38.x);
    - grbl: lines with ``[PRB:x,y,z:1]``; those that end in 0 were no contact and are left out;
    - words ``X1.5 Y-20 Z3``, or a table with columns named after the axes.

    With a table of ball centres as ``--artefact``, the contacts are taken in their order,
    ``--contacts`` at a time, for one ball after the other as the table lists them; when all balls
    were measured, the next pose of the artefact begins. The centre of a ball is that of the sphere,
    of any radius, with the least sum of squared distances to its contacts (four at least). With
    ``--contacts 1`` the log holds centres. They become a ball array.

    Otherwise every contact counts (`touch_probe`): those with a sphere or a ring, all in one
    clamping, or ``--contacts`` in each; or those with a step gauge, whose faces are the table
    ``--artefact``, in a log with the columns ``face`` and ``approach``.
    """

    name = "probe_log"
    summary = "contacts of the machine's own probe: LinuxCNC, grbl, words X Y Z, tables"
    needs = (
        "--machine, --tool-offset, --unit; for balls --artefact and --contacts; otherwise "
        "--set instrument.artefact=sphere (or ring), diameter_mm and stylus_radius_mm; the noise "
        "as --set instrument.probe_sigma_um=..."
    )
    source = (
        "LinuxCNC documentation, G38.n Straight Probe: PROBEOPEN (linuxcnc.org/docs); grbl wiki, "
        "Interface: the message [PRB:...]"
    )
    undocumented = (
        "the unit of the lengths (that of the program or of the settings; --unit); which contact "
        "is of which ball; angles are taken in degrees"
    )
    keys = _KEYS
    levers = True

    def sniff(self, export: Export) -> float:
        text = export.text
        if text is None:
            return NO
        if _GRBL.search(text):
            return SURE
        table = export.attempted
        if table is None:
            lines = [line for line in text.splitlines() if line.strip()][:200]
            worded = sum(len(_WORD.findall(line)) >= 3 for line in lines)
            return LIKELY if lines and worded > 0.8 * len(lines) else NO
        if not table.header:
            numeric = all(table.is_numeric(place) for place in range(table.width))
            if numeric and table.width == 9:
                return LIKELY
            return POSSIBLE if numeric and table.width == 3 else NO
        names = names_of(table)
        roles = {name.role for name in names}
        told = any("probe" in text.casefold() for text in table.comments)
        axes = {"x", "y", "z"} <= roles and roles <= {*_NINE.lower(), "name", None}
        return (LIKELY if told else POSSIBLE) if axes else NO

    def read(
        self, export: Export, options: Options, machine: Machine | None, needs: Needs
    ) -> Sequence[DataSet]:
        found, stated = _contacts(export, options, needs)
        balls, faces = _artefact(options, needs)
        if balls is not None and options.contacts is None:
            needs.add("--contacts N", "number of contacts per ball; 1 where the log holds centres")
        if not stated and options.unit is None:
            needs.add("--unit", "unit of the lengths, which such a log does not state: mm, inch")
        if balls is None:
            for key, meaning in _SIZES.items():
                if key not in options.given and (faces is None or key == "stylus_radius_mm"):
                    needs.add(f"--set instrument.{key}=VALUE", meaning)
        if machine is None:
            needs.add(*MACHINE)
        if machine is None or (balls is not None and options.contacts is None):
            return []
        axes = machine.chain.axes
        if missing := [axis for axis in axes if axis not in found]:
            raise refusal(
                export.name,
                "columns",
                f"no position of {listed(missing)}",
                f"the axes of the machine, {listed(axes)}",
                "declare the machine of the log, or add the columns",
            )
        if balls is None:
            return [_touched(export, found, faces, machine, options)]
        return [_centres(export, found, balls, machine, options.contacts or 1)]


def _centres(
    export: Export,
    found: dict[str, np.ndarray],
    balls: Float[np.ndarray, "balls 3"],
    machine: Machine,
    count: int,
) -> DataSet:
    """The data set of a ball array."""
    axes = machine.chain.axes
    rows = len(found["X"])
    if rows % count:
        raise refusal(
            export.name,
            "rows",
            f"{rows} contacts, which are not a multiple of {count}",
            "the same number of contacts on every ball (--contacts)",
            "correct the number, or add or remove contacts",
        )
    groups = rows // count
    centres = {axis: found[axis].reshape(groups, count).mean(1) for axis in axes}
    turned = max(
        (np.ptp(found[a].reshape(groups, count), axis=1).max() for a in axes if a in ROTARY),
        default=0.0,
    )
    if turned > 0.0:
        raise refusal(
            export.name,
            "rows",
            "rotary axes that move between the contacts of one ball",
            "one setting of the rotary axes per ball",
            "correct --contacts",
        )
    notes = [f"{groups} centres of balls from {rows} contacts"]
    if count > 1:
        points = np.column_stack([found[axis] for axis in "XYZ"]).reshape(groups, count, 3)
        fitted = [_sphere(part, export, k * count, count) for k, part in enumerate(points)]
        radii = np.array([radius for _, radius in fitted])
        for i, axis in enumerate("XYZ"):
            centres[axis] = np.array([centre[i] for centre, _ in fitted])
        notes.append(
            f"the spheres have a radius of {radii.mean():.4f} mm, standard deviation "
            f"{1e3 * radii.std():.2g} um"
        )
    order = np.arange(groups)
    columns: dict[str, np.ndarray] = {
        "pose": order // len(balls),
        "ball": order % len(balls),
    }
    for axis in axes:
        columns[file_column(axis, axes)[0]] = centres[axis]
    instrument = {"kind": "ball_array", "artefact": "artefact.csv"}
    text = "ball,x_mm,y_mm,z_mm\n" + "".join(
        f"{k},{','.join(repr(float(v)) for v in ball)}\n" for k, ball in enumerate(balls)
    )
    files = {"artefact.csv": text.encode()}
    return DataSet(export.path.stem, instrument, columns, _KEYS, notes, files)


def _touched(
    export: Export,
    found: dict[str, np.ndarray],
    faces: Float[np.ndarray, "faces 2"] | None,
    machine: Machine,
    options: Options,
) -> DataSet:
    """The data set of single contacts with a sphere, a ring or a step gauge."""
    axes = machine.chain.axes
    rows = len(found["X"])
    columns = {"setup": np.arange(rows) // (options.contacts or rows)}
    for axis in axes:
        columns[file_column(axis, axes)[0]] = found[axis]
    if export.attempted is not None and export.table.header:
        table = export.table
        for place, name in enumerate(table.header):
            if _OWN.fullmatch(name):
                columns[name] = table.numbers(place)
    instrument: dict[str, str] = {"kind": "touch_probe"}
    files = {}
    if faces is not None:
        if missing := [name for name in ("face", "approach") if name not in columns]:
            raise refusal(
                export.name,
                "header",
                f"no column {listed(missing)}",
                "the number of the face, and approach: 1 in the sense of rising positions, or -1",
                "add the columns, as a log of contacts does not say which face was touched",
            )
        instrument |= {"artefact": "step_gauge", "gauge": "gauge.csv"}
        text = "".join(f"{int(face)},{float(place)!r}\n" for face, place in faces)
        files["gauge.csv"] = f"face,position_mm\n{text}".encode()
    for name in ("setup", "run", "face", "approach"):
        if name in columns:
            columns[name] = columns[name].astype(int)
    setups = len(np.unique(columns["setup"]))
    notes = [f"{rows} contacts in {setups} clamping{'s' * (setups > 1)} of the artefact"]
    return DataSet(export.path.stem, instrument, columns, _KEYS, notes, files)


def _contacts(export: Export, options: Options, needs: Needs) -> tuple[dict[str, np.ndarray], bool]:
    """Positions by axis, mm and deg, and whether the file states the unit."""
    text = export.text or ""
    factor = Units.given_mm(options)
    if grbl := _GRBL.findall(text):
        table = [[number(v) for v in values.split(",")] for values, hit in grbl if hit == "1"]
        return _by_axis(export, table, _NINE, factor), False
    if export.attempted is None:
        lines = [dict(_WORD.findall(line)) for line in text.splitlines()]
        words = [line for line in lines if {"X", "Y", "Z"} <= line.keys()]
        axes = [axis for axis in _NINE if all(axis in line for line in words)] if words else []
        table = [[float(line[axis]) for axis in axes] for line in words]
        return _by_axis(export, table, axes, factor), False
    table = export.table
    if not table.header:
        values = np.column_stack([table.numbers(place) for place in range(table.width)])
        return _by_axis(export, values, _NINE, factor), False
    names = names_of(table)
    units = Units(table, options, needs)
    found: dict[str, np.ndarray] = {}
    for role, place in places(names).items():
        axis = role.upper()
        if axis in LINEAR and len(axis) == 1:
            found[axis] = table.numbers(place) * units.length_mm(names[place])
        elif axis in ROTARY and len(axis) == 1:
            unit = names[place].unit
            values = table.numbers(place)
            other = unit in ANGLES_RAD and unit not in ("deg", "degree", "°")
            found[axis] = np.rad2deg(values * ANGLES_RAD[unit or "deg"]) if other else values
    return found, True


def _by_axis(
    export: Export, table: Sequence[Sequence[float]] | np.ndarray, axes: Sequence[str], mm: float
) -> dict[str, np.ndarray]:
    if not len(table):
        raise refusal(
            export.name, "file", "no contact", "positions of X, Y and Z", "name another file"
        )
    for k, row in enumerate(table):
        if len(row) != len(table[0]) or len(row) < 3 or not np.isfinite(row).all():
            raise refusal(
                export.name,
                f"contact {k + 1}",
                f"{len(row)} cells, {int(np.isfinite(row).sum())} of them numbers",
                f"{max(len(table[0]), 3)} numbers, as in the first contact",
                "correct the line, or remove it",
            )
    values = np.asarray(table, float)
    return {
        axis: column * (1.0 if axis in ROTARY else mm)
        for axis, column in zip(axes, values.T, strict=False)
    }


def _artefact(
    options: Options, needs: Needs
) -> tuple[Float[np.ndarray, "balls 3"] | None, Float[np.ndarray, "faces 2"] | None]:
    """The calibrated centres of balls, or the numbers and positions of faces, mm; None for what the
    table ``--artefact`` is not.
    """
    if options.artefact is None:
        return None, None
    table = Export(options.artefact).table
    names = names_of(table)
    where = places(names)
    units = Units(table, options, needs)
    if all(c in where for c in "xyz"):
        columns = [table.numbers(where[c]) * units.length_mm(names[where[c]]) for c in "xyz"]
        return np.column_stack(columns), None
    texts = [re.sub(r"[\[(].*", "", text).strip().casefold() for text in table.header]
    face = next((i for i, text in enumerate(texts) if text in ("face", "no", "i")), None)
    place = next((i for i, text in enumerate(texts) if text.startswith("position")), None)
    if face is not None and place is not None:
        position = table.numbers(place) * units.length_mm(names[place])
        return None, np.column_stack([table.numbers(face), position])
    raise refusal(
        table.name,
        "header",
        f"columns {listed(table.header)}",
        "the centres of balls (x, y, z), or the faces of a step gauge (face, position)",
        "add a header, such as ball,x_mm,y_mm,z_mm or face,position_mm",
    )


def _sphere(
    points: Float[np.ndarray, "n 3"], export: Export, first: int, count: int
) -> tuple[Float[np.ndarray, "3"], float]:
    """Centre and radius of the sphere with the least sum of squared distances to points, from the
    linear (algebraic) solution by Gauss-Newton steps. Raises `StudyError` for points in a plane.
    """
    middle = points.mean(0)
    p = points - middle
    if count < 4 or np.linalg.svd(p)[1][2] <= 1e-6 * np.abs(p).max():
        raise refusal(
            export.name,
            f"contacts {first + 1} to {first + count}",
            f"{count} contacts" + (" in one plane" if count >= 4 else ""),
            "at least four on one ball that are not in a plane",
            "correct --contacts, or measure more",
        )
    solution = np.linalg.lstsq(
        np.column_stack([2.0 * p, np.ones(count)]), (p**2).sum(1), rcond=None
    )[0]
    centre, radius = solution[:3], float(np.sqrt(solution[3] + solution[:3] @ solution[:3]))
    for _ in range(_STEPS):
        away = p - centre
        length = np.linalg.norm(away, axis=1)
        design = np.column_stack([-away / length[:, None], -np.ones(count)])
        step = np.linalg.lstsq(design, radius - length, rcond=None)[0]
        centre, radius = centre + step[:3], radius + float(step[3])
        if np.abs(step).max() < _FOUND_MM:
            break
    return centre + middle, radius
