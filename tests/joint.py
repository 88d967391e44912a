"""Studies of several data sets, put together from those that the oracle writes one by one."""

import dataclasses
import shutil
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from oracle import Case, in_si, measure_tracker, write_study
from oracle.study import run_columns


def write_joint(folder: Path, cases: Mapping[str, Case]) -> Path:
    """One study of all cases, which are of one machine; the tables are named after the data sets.

    Machine, family and check points are those of the first.
    """
    folder.mkdir(parents=True)
    texts = []
    for name, case in cases.items():
        own = write_study(folder / f"alone_{name}", case)
        text = (own / "setup.toml").read_text(encoding="utf-8")
        head, rest = text.split("[instrument]")
        instrument, model = rest.split("[model.geometric]")
        shutil.copy(own / "data.csv", folder / f"{name}.csv")
        if case.artefact is not None:
            shutil.copy(own / "artefact.csv", folder / f"{name}_artefact.csv")
            instrument = instrument.replace("artefact.csv", f"{name}_artefact.csv")
        row = f'[[data]]\nname = "{name}"\nfile = "{name}.csv"\n[data.instrument]{instrument}'
        texts.append((head, row, f"[model.geometric]{model}"))
        if len(texts) == 1:
            for table in ("errors.csv", "check.csv"):
                shutil.copy(own / table, folder / table)
    rows = "".join(row for _, row, _ in texts)
    (folder / "setup.toml").write_text(texts[0][0] + rows + texts[0][2], encoding="utf-8")
    return folder


def alone(folder: Path, name: str) -> Path:
    """The study of one of the cases by itself, as the oracle wrote it."""
    return folder / f"alone_{name}"


def at_temperatures(
    case: Case, degrees: Sequence[float], effects: Sequence[Mapping[str, Any]], seed: int
) -> Case:
    """The same tracker at the same places of the same machine, its scales at other temperatures."""
    run = dataclasses.replace(case.run, temperature=np.tile(degrees, (len(case.run.t), 1)))
    si = [in_si(effect) for effect in effects]
    readings = measure_tracker(case.machine, run, case.tracker, np.random.default_rng(seed), si)
    data = {"point": case.data["point"]} | run_columns(run)
    data |= dict(
        zip(
            ("range_mm", "azimuth_rad", "elevation_rad"),
            readings.T * np.array([[1e3], [1.0], [1.0]]),
            strict=True,
        )
    )
    return dataclasses.replace(case, run=run, readings=readings, data=data)
