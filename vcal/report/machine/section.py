"""The part of a page that shows the declared machine: its axes as a table, and its pictures."""

import math
from collections.abc import Sequence

import numpy as np

from ...geometry.declared_machine import (
    DeclaredMachine,
    Measured,
    Seen,
    ShownAxis,
    declared_machine,
)
from ...plots import axis_label, machine_views, smallest_text, svg
from ...plots.declared_machine import SHOWN
from ...study.study import Study
from ..html.picture import Picture, Shown
from ..html.sheet import Section, Table
from ..html.text import DASH, number

SECTION = "declared machine"
"""Part of the page in which the pictures are shown."""
_CSS_DPI = 96.0
"""Pixels of a page in an inch."""
_TITLES = {
    "xz": "XZ, seen from −Y",
    "yz": "YZ, seen from +X",
    "xy": "XY, seen from +Z",
    "space": "pictorial view",
}
_AXES = {tuple(sign * row): f"{'+-'[sign < 0]}{name}" for name, row in zip(
    "XYZ", np.eye(3, dtype=int), strict=True) for sign in (1, -1)}  # fmt: skip


def of_study(study: Study) -> DeclaredMachine:
    """The declared machine of a study with its data sets."""
    return declared_machine(
        study.chain,
        [
            Measured(
                one.name,
                one.settings.kind.replace("_", " "),
                one.chain,
                one.instrument if one.declared is None else one.declared,
                one.instrument,
                one.plan,
                one.readings,
            )
            for one in study.sets
        ],
    )


def machine_pictures(machine: DeclaredMachine) -> list[Picture]:
    """The views of the declared machine, with what they show in words."""
    words = " ".join((_sentence(machine), *map(_of_data, machine.seen)))
    return [
        Picture(
            f"machine_{key}",
            SECTION,
            "",
            svg(drawn),
            alt=f"The declared machine, {_TITLES[key]}. {words}",
            half=True,
            text_px=smallest_text(drawn, _CSS_DPI),
        )
        for key, drawn in machine_views(machine).items()
    ]


def machine_sections(machine: DeclaredMachine | None, shown: Shown) -> list[Section]:
    """Chain, axes with their senses, zero, travels, tool and instruments, with the pictures of
    `machine_pictures` among those `shown`; nothing without a machine.
    """
    return [] if machine is None else [_section(machine, shown.get(SECTION, ()))]


def _section(machine: DeclaredMachine, drawn: Sequence[Picture]) -> Section:
    pose = "with all joints" if machine.arm else "with all axes"
    frame = "base" if machine.arm else "workpiece"
    paragraphs = [
        f"{_sentence(machine)} Pictures and table follow from the declared chain by its forward "
        f"kinematics, in the frame of the {frame}, {pose} at zero. Check that every arrow points "
        "and turns as the machine does.",
        *(words for one in machine.seen if (words := _of_data(one))),
    ]
    header = ("axis", "moves", "positive command", "at, mm", "travel", "measured")
    rows = [_row(axis) for axis in machine.axes]
    note = "At: a point on the axis of rotation, with all axes at zero."
    if machine.coupled:
        note += " The joints are coupled: the senses are those of the joints, not of the commands."
    table = Table(header, rows, note=note)
    return Section("Declared machine", tuple(paragraphs), tables=(table,), pictures=tuple(drawn),
                   note=_legend(machine))  # fmt: skip


def _sentence(machine: DeclaredMachine) -> str:
    """The chain from the workpiece to the tool, and the tool."""
    if machine.arm:
        chain = f"base → {' → '.join(machine.tool_side)} → tool"
    else:
        parts = ["workpiece", *machine.workpiece_side, "bed", *machine.tool_side, "tool"]
        chain = " → ".join(parts)
    offset = machine.tool_rotation.T @ (machine.tool_point - machine.tool_origin)
    return (
        f"Chain: {chain}. The tool point is at {_place(machine.tool_point)} mm "
        f"(tool offset {_place(offset)} mm)."
    )


def _of_data(one: Seen) -> str:
    """Where the instrument is, and whether the readings follow the declared machine."""
    words = []
    for mark in one.marks:
        if mark.frame is not None:
            place = f"The {mark.name} is declared at {_place(mark.places[0])} mm"
            if mark.azimuth:
                place += f", the zero of its azimuth points along {_direction(mark.frame[:, 0])}"
            words.append(f"{place}.")
    if one.measured is not None and one.rms is not None:
        words.append(
            "After the best rigid fit, the measured points differ from the declared machine by "
            f"{number(1e3 * one.rms)} mm (rms)."
        )
        if not one.follows:
            words.append("They do not follow it: check the chain, signs, units and columns.")
    if one.station is not None:
        place = f"The readings place the {one.station.name} at {_place(one.station.places[0])} mm"
        if one.moved is not None:
            place += f", {number(1e3 * one.moved)} mm from where it is declared"
        if one.station.azimuth and one.station.frame is not None:
            place += f", with the zero of its azimuth along {_direction(one.station.frame[:, 0])}"
        words.append(f"{place}.")
    if not words:
        return ""
    return f"{one.name + ': ' if one.name else ''}{' '.join(words)}"


def _legend(machine: DeclaredMachine) -> str:
    """What the marks of the pictures mean."""
    words = [
        "Arrows: motion by a positive command; ⊙ towards the viewer, ⊗ away from the viewer. The "
        "near side of a circle is thick."
    ]
    if any(axis.moves == "workpiece" for axis in machine.axes):
        words.append(
            "Blue: axes that move the tool. Orange, with a prime (ISO 841): axes that move the "
            "workpiece, against their letter, so that the tool moves in the positive direction "
            "relative to the workpiece."
        )
    if machine.travel is not None:
        words.append(
            "Grey box: tool points over the declared travel"
            + (", with the rotary axes at zero." if any(a.turns for a in machine.axes) else ".")
        )
    if machine.arm:
        words.append(
            "Thick: links at the zero pose, which is alone in the pictorial view; thin: links at "
            "some measured poses, by their rows."
        )
    words.append("Grey dots: nominal places of the measured points.")
    if any(one.measured is not None for one in machine.seen):
        words.append(
            "Purple crosses: measured points after the best rigid fit, where they are farther than "
            f"{100 * SHOWN:g} % of the size of the machine from the nominal ones."
        )
    if any(one.marks or one.station for one in machine.seen):
        words.append(
            "Green: the instrument; one that is more than twice the size of the machine away is "
            "drawn in its direction, with its distance."
        )
    return " ".join(words)


def _row(axis: ShownAxis) -> tuple[str, ...]:
    unit, factor = ("deg", math.degrees(1.0)) if axis.turns else ("mm", 1e3)
    if axis.turns:
        motion = f"turns it about {_direction(axis.direction)} (right-hand rule)"
    else:
        motion = f"moves it along {_direction(axis.direction)}"
    known = bool(np.isfinite(axis.travel).all())
    return (
        axis_label(axis).removeprefix("+"),
        f"the {axis.moves}",
        motion,
        _place(axis.place) if axis.turns else DASH,
        _range(factor * axis.travel, unit) if known else "not declared",
        _range(factor * axis.covered, unit) if np.isfinite(axis.covered).all() else DASH,
    )


def _range(ends: np.ndarray, unit: str) -> str:
    return f"{_number(ends[0])} to {_number(ends[1])} {unit}"


def _place(place: np.ndarray) -> str:
    """Coordinates in mm."""
    return f"({', '.join(_number(v) for v in 1e3 * np.asarray(place))})"


def _number(value: float) -> str:
    text = f"{round(float(value), 3) + 0.0:.7g}"
    return text.replace("-", "−")


def _direction(v: np.ndarray) -> str:
    """A unit vector as ``"+X"`` where it is along an axis, else as its components."""
    whole = np.round(v)
    if np.abs(v - whole).max() < 1e-6 and tuple(whole.astype(int)) in _AXES:
        return _AXES[tuple(whole.astype(int))].replace("-", "−")
    return f"({', '.join(f'{x + 0.0:.3g}'.replace('-', '−') for x in np.round(v, 3))})"
