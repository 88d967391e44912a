"""A designed plan as files: the table of the plan, the artefact, and a study around them."""

from collections.abc import Mapping, Sequence
from pathlib import Path, PurePath
from typing import Any

import numpy as np
import tomli_w

from ...design.plan_space import PlanSpace
from ...files import write_file
from ..csv_table import write_table
from ..messages import refusal
from ..own_format import with_own_tables
from ..study import Study
from ..toml_file import read_setup

PLAN, ARTEFACT, SETUP = "plan.csv", "artefact.csv", "setup.toml"


def plan_table(study: Study, space: PlanSpace, placed: Any) -> dict[str, np.ndarray]:
    """A plan as the columns of a data table, without the columns of readings."""
    instrument, plan = space.instrument(placed), space.plan(placed)
    kind, axes = study.one.settings, study.chain.axes
    plain, full = (
        {c.name for c in instrument.columns(kind, axes, readings=readings)}
        for readings in (False, True)
    )
    table = instrument.to_table(plan, np.zeros((plan.rows, len(instrument.readings))))
    return {name: values for name, values in table.items() if name not in full - plain}


def write_plan(study: Study, space: PlanSpace, placed: Any, work: Path) -> list[str]:
    """Write the plan alone; returns the names of the files written."""
    write_table(work / PLAN, plan_table(study, space, placed))
    return [PLAN]


def write_designed(
    study: Study,
    overrides: Mapping[str, Any] | Sequence[str],
    space: PlanSpace,
    placed: Any,
    work: Path,
) -> list[str]:
    """Write the designed plan as a study folder of its own; returns the names of the files written.

    The folder holds the plan, the artefact of a space that has one, and the study file with the
    overrides applied and without its comments. Files that the study names are copied. Check points
    are left out, as they belong to a measured machine, and further families are left out too.
    Raises `StudyError` where two files of the study have the same name.
    """
    files = write_plan(study, space, placed, work)
    raw, _ = read_setup(study.path, overrides)
    check = study.single.data.check or "check.csv"
    raw = with_own_tables(raw, (study.one.file, check))
    artefact = space.artefact(placed)
    data = raw.setdefault("data", {})
    replaced = {study.path.name, study.one.file, check}
    if artefact is not None:
        replaced.add(str(raw["instrument"]["artefact"]))
        raw = with_own_tables(raw, (raw["instrument"]["artefact"],))
        data = raw["data"]
        raw["instrument"]["artefact"] = ARTEFACT
        write_table(work / ARTEFACT, artefact)
        files.append(ARTEFACT)
    data.pop("file", None)
    data["data"] = PLAN
    data.pop("check", None)
    raw.get("design", {}).pop("families", None)
    raw["instrument"] |= dict(space.changed(placed))
    moved = {}
    for name in study.hashes:
        if name in replaced:
            continue
        moved[name] = PurePath(name).name
        if moved[name] in files or moved[name] == SETUP:
            raise refusal(
                study.path.name,
                f"file {name}",
                f"a second file named {moved[name]!r} in the folder to be written",
                "every name once",
                "rename the file",
            )
        write_file(work / moved[name], (study.folder / name).read_bytes())
        files.append(moved[name])
    head = (
        f"# Written by `vcal design` from {study.path.name}: the study of the plan in {PLAN}.\n\n"
    )
    text = head + tomli_w.dumps(_renamed(raw, moved))
    write_file(work / SETUP, text)
    return [*files, SETUP]


def _renamed(tree: Any, names: Mapping[str, str]) -> Any:
    if isinstance(tree, dict):
        return {names.get(key, key): _renamed(value, names) for key, value in tree.items()}
    if isinstance(tree, list):
        return [_renamed(value, names) for value in tree]
    if not isinstance(tree, str):
        return tree
    file, mark, sheet = tree.partition("#")
    return names.get(tree) or names.get(file, file) + mark + sheet
