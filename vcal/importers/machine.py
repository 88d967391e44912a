"""The machine of an imported study: a chain, a study file, or a URDF file."""

import re
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import tomli_w

from ..instruments.conditions import LINEAR, ROTARY
from ..study.folder import Folder
from ..study.messages import refusal
from ..study.settings import MachineSettings, validate
from ..study.study import build_chain
from ..study.toml_file import read_setup
from .base import Machine, Needs

SETUP = "setup.toml"
TOOL_OFFSET = (
    "--tool-offset X,Y,Z",
    "vector from the frame of the last axis to the measured point, mm: the lever of angular errors",
)
"""What a machine tool needs of the user, with its meaning."""
_GRID_MM = 10.0
"""A travel that only the measured positions tell ends at a multiple of this."""


def declared(text: str) -> tuple[dict[str, Any], dict[str, bytes]]:
    """The ``[machine]`` table of ``--machine``, and the files that it names.

    The text is a chain by ISO 10791-6, a study file or folder whose ``[machine]`` is taken, or a
    URDF file. Raises `StudyError` for a file that does not exist or has no machine.
    """
    path = Path(text)
    if path.is_dir():
        path = path / SETUP
    if path.suffix.casefold() == ".toml":
        raw, _ = read_setup(path)
        machine = raw.get("machine")
        if not isinstance(machine, dict):
            raise refusal(
                path.name, "key machine", "nothing", "the machine of a study", "name another file"
            )
        files = {}
        if isinstance(urdf := machine.get("urdf"), str):
            files[urdf] = Folder(path.parent).path(urdf, "a URDF file").read_bytes()
        return machine, files
    if path.suffix.casefold() in (".urdf", ".xml"):
        if not path.is_file():
            raise refusal(
                path.name, "file", f"no such file in {path.parent}", "a URDF file", "correct it"
            )
        return {"urdf": path.name}, {path.name: path.read_bytes()}
    return {"chain": text}, {}


def built(
    tree: Mapping[str, Any], files: Mapping[str, bytes], overrides: Sequence[str]
) -> tuple[dict[str, Any], Machine]:
    """The ``[machine]`` table with the overrides of its keys, and the machine built from it.

    Raises `StudyError` for keys that are no machine.
    """
    own = [text for text in overrides if text.partition("=")[0].strip().startswith("machine.")]
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        for file, data in files.items():
            (folder / file).write_bytes(data)
        path = folder / SETUP
        path.write_text(tomli_w.dumps({"machine": dict(tree)}), encoding="utf-8")
        raw, given = read_setup(path, own)
        table = raw["machine"]
        # Validated with an instrument of every machine, so that messages name keys of [machine].
        kind = {"kind": "reflectors", "tool_reflectors": 1, "sigma_um": 1.0}
        whole = validate({"machine": table, "instrument": kind}, SETUP, given, Folder(folder))
        settings: MachineSettings = whole.machine
        chain = build_chain(settings, SETUP, Folder(folder))
    return table, Machine(table, chain, files)


def completed(
    table: dict[str, Any], machine: Machine, columns: Mapping[str, Any], needs: Needs
) -> list[str]:
    """Add what the positions tell to a ``[machine]`` table; returns notes on it.

    The travel of an axis that is not declared becomes the range of its positions, rounded outwards.
    That of an axis that stands still has to be given.
    A machine tool needs its tool offset, and every rotary axis a point on it, from the user.
    """
    if machine.arm:
        return []
    notes = []
    if "tool_offset_mm" not in table:
        needs.add(*TOOL_OFFSET)
    travel = dict(table.get("travel_mm", {}))
    guessed = []
    for axis in machine.chain.axes:
        values = columns.get(f"{axis.lower()}_{'mm' if axis in LINEAR else 'deg'}")
        if axis in ROTARY:
            rotary = table.get("rotary", {}).get(axis, {})
            if "at_mm" not in rotary:
                needs.add(
                    f"--set machine.rotary.{axis}.at_mm=[x,y,z]", "a point on the rotary axis, mm"
                )
        elif axis not in travel and values is not None:
            low, high = float(np.min(values)), float(np.max(values))
            if high - low < _GRID_MM:
                needs.add(
                    f"--set machine.travel_mm.{axis}=[LOW,HIGH]",
                    f"travel of {axis} in mm, as it stands still in the file",
                )
                continue
            low = _GRID_MM * np.floor(low / _GRID_MM)
            high = _GRID_MM * np.ceil(high / _GRID_MM)
            travel[axis] = [float(low), float(high)]
            guessed.append(axis)
    if guessed:
        table["travel_mm"] = travel
        notes.append(
            f"machine.travel_mm of {', '.join(guessed)} is the range of the measured positions: "
            "replace it by the travel of the machine"
        )
    return notes


def offset_of(text: str) -> list[float]:
    """A tool offset ``X,Y,Z`` in mm; raises `StudyError` for another text."""
    parts = re.split(r"[,;\s]+", text.strip().strip("[]"))
    try:
        values = [float(part) for part in parts]
    except ValueError:
        values = []
    if len(values) != 3 or not np.isfinite(values).all():
        raise refusal(
            "--tool-offset", "option", repr(text), "three numbers X,Y,Z in mm", "correct them"
        )
    return values


def with_overrides(text: str, overrides: Sequence[str], several: int) -> dict[str, Any]:
    """The tree of a study file with overrides; ``instrument.KEY`` concerns every data set."""
    expanded = []
    for one in overrides:
        key, equals, value = one.partition("=")
        key = key.strip()
        if several > 1 and key.startswith("instrument."):
            expanded += [f"data.{i}.{key}{equals}{value}" for i in range(several)]
        else:
            expanded.append(one)
    with tempfile.TemporaryDirectory() as name:
        path = Path(name) / SETUP
        path.write_text(text, encoding="utf-8")
        return read_setup(path, expanded)[0]
