"""The machine of an imported study: a chain, a study file, or a URDF file."""

import re
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import tomli_w

from ..instruments.conditions import ROTARY
from ..study.consent import require_inside
from ..study.declared_chain import build_chain
from ..study.folder import Folder
from ..study.messages import refusal
from ..study.settings import MachineSettings, validate
from ..study.toml_file import read_setup
from .base import Machine, Needs

SETUP = "setup.toml"
TOOL_OFFSET = (
    "--tool-offset X,Y,Z",
    "vector from the frame of the last axis to the measured point, mm: the lever of angular errors",
)
"""What a machine tool needs of the user, with its meaning."""
_GRID = 10.0
"""A travel that only the measured positions tell ends at a multiple of this, mm or deg."""


def declared(text: str, outside: bool = False) -> tuple[dict[str, Any], dict[str, bytes]]:
    """The ``[machine]`` table of ``--machine``, and the files that it names.

    The text is a chain by ISO 10791-6, a study file or folder whose ``[machine]`` is taken, or a
    URDF file. Raises `StudyError` for a file that does not exist or has no machine, and for files
    of a study outside its folder, unless `outside` allows them.
    """
    path = Path(text)
    if path.is_dir():
        path = path / SETUP
    if path.suffix.casefold() == ".toml":
        require_inside(path.parent, path.name, allowed=outside)
        raw, _ = read_setup(path)
        machine = raw.get("machine")
        if not isinstance(machine, dict):
            raise refusal(
                path.name, "key machine", "nothing", "the machine of a study", "name another file"
            )
        files = {}
        if isinstance(urdf := machine.get("urdf"), str):
            # The copy lies in the study folder, wherever the file of the other study lies.
            name = Path(urdf).name
            folder = Folder(path.parent, outside=outside)
            files[name] = folder.path(urdf, "a URDF file").read_bytes()
            machine = {**machine, "urdf": name}
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
        filled = _with_places(table)
        # Validated with an instrument of every machine, so that messages name keys of [machine].
        kind = {"kind": "reflectors", "tool_reflectors": 1, "sigma_um": 1.0}
        whole = validate({"machine": filled, "instrument": kind}, SETUP, given, Folder(folder))
        settings: MachineSettings = whole.machine
        chain = build_chain(settings, SETUP, Folder(folder))
    return table, Machine(table, chain, files)


def _with_places(table: Mapping[str, Any]) -> Mapping[str, Any]:
    """The table with any place of the rotary axes that have none: `completed` asks for them."""
    chain, rotary = table.get("chain"), table.get("rotary", {})
    if not isinstance(chain, str) or not isinstance(rotary, dict):
        return table
    found = dict(rotary)
    for axis in chain.split():
        own = found.get(axis, {})
        if axis in ROTARY and isinstance(own, dict) and "at_mm" not in own:
            found[axis] = {"at_mm": [0.0, 0.0, 0.0], **own}
    return {**table, "rotary": found} if found else table


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
    rotary = {axis: dict(row) for axis, row in table.get("rotary", {}).items()}
    guessed = []
    for axis in machine.chain.axes:
        turns = axis in ROTARY
        if turns and "at_mm" not in rotary.get(axis, {}):
            needs.add(
                f"--set machine.rotary.{axis}.at_mm=[X,Y,Z]", "a point on the rotary axis, mm"
            )
        values = columns.get(f"{axis.lower()}_{'deg' if turns else 'mm'}")
        if values is None or (axis in travel or "travel_deg" in rotary.get(axis, {})):
            continue
        key = f"machine.rotary.{axis}.travel_deg" if turns else f"machine.travel_mm.{axis}"
        low, high = float(np.min(values)), float(np.max(values))
        if high - low < _GRID:
            needs.add(
                f"--set {key}=[LOW,HIGH]",
                f"travel of {axis} in {'deg' if turns else 'mm'}, as it stands still in the file",
            )
            continue
        ends = [float(_GRID * np.floor(low / _GRID)), float(_GRID * np.ceil(high / _GRID))]
        guessed.append(axis)
        if turns:
            rotary.setdefault(axis, {})["travel_deg"] = ends
        else:
            travel[axis] = ends
    if travel:
        table["travel_mm"] = travel
    if rotary:
        table["rotary"] = rotary
    if guessed:
        notes.append(
            f"the travel of {', '.join(guessed)} in [machine] is the range of the measured "
            "positions: replace it by that of the machine"
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
