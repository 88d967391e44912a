"""Study folders with simulated data: the command `vcal simulate`."""

import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import Any

import jax
import numpy as np
import tomli_w
from pydantic import ValidationError

from ..effects.base import Effect, Setup
from ..errors import StudyError
from ..files import write_file
from ..instruments.conditions import file_name, inside_name, linear_plan, linear_plan_table
from ..model.forward import Model
from ..model.simulate import Simulated, scattered, simulate
from .csv_table import Table, write_table
from .data_sets import DataSet
from .declared_effects import Catalogue, beside, declared_effects, unknown_effect
from .folder import made_whole, require_empty
from .messages import refusal, shown
from .own_format import own_name, with_own_tables
from .settings import COMPUTABLE, EffectSettings, computable
from .study import Study
from .toml_file import read_setup

_CHECK_ROWS = 400
_MOST_NOISE = 1e6
_WITH = "NAME, NAME:PLACEMENT or NAME:PLACEMENT:KEY=VALUE,..., such as backlash:Y:size_um=12"


def parse_with(
    text: str,
    catalogue: Catalogue,
    setup: Setup,
    files: Mapping[str, str] = MappingProxyType({"": "data.csv"}),
) -> Effect:
    """An effect from ``NAME:PLACEMENT:KEY=VALUE,KEY=VALUE``, such as ``backlash:Y:size_um=12``.

    The keys are those of a ``[[model.effect]]`` row: parameters with their unit, ``component``,
    ``data_set`` and ``*_sigma``. A parameter with a value is known; one without a value has its
    prior. An effect without a placement leaves it out: ``range_scale:scale_um_per_m=3``. `files`
    maps the name of every data set to its table (`Study.files`), for messages.

    Raises `StudyError` for an unknown name, placement or key (with the nearest one), for a value
    that is not a number, for a text that fits several components, for an effect whose covariate the
    data lack, and for an effect that is declared already.
    """
    file = f"--with {text}"
    name, *parts = (part.strip() for part in text.split(":"))
    values = parts.pop() if parts and "=" in parts[-1] else ""
    if not name or len(parts) > 1 or "" in parts:
        raise StudyError(f"{file}: found {text!r}, expected {_WITH}; write it so")
    row: dict[str, Any] = {"name": name, "placement": parts[0] if parts else ""}
    for pair in filter(None, (p.strip() for p in values.split(","))):
        key, equals, value = (p.strip() for p in pair.partition("="))
        if not equals or not key or not value or key in row:
            found = f"{key} a second time" if key in row else repr(pair)
            raise refusal(file, "values", found, "KEY=VALUE, every key once", "correct it")
        row[key] = _value(value)
        if isinstance(row[key], int | float) and not computable(row[key]):
            found, expected = shown(value).strip('"'), "a finite number"
            if isinstance(row[key], int) or math.isfinite(row[key]):
                expected = COMPUTABLE
            raise refusal(file, f"key {key}", found, expected, "correct the value")
    if name not in catalogue:
        raise unknown_effect(name, catalogue, file, "name")
    try:
        settings = EffectSettings.model_validate(row)
    except ValidationError as error:
        key = ".".join(str(k) for k in error.errors()[0]["loc"])
        raise refusal(file, f"key {key}", repr(row[key]), "text", "correct the value") from error
    try:
        (effect,) = declared_effects([settings], catalogue, setup, file, files)
    except StudyError as error:
        # The messages are worded for a row of the study file.
        message = str(error).replace("key model.effect.0.", "key ")
        message = message.replace(f"(model.effect.0 of {file})", f"of {file}")
        message = message.replace("key model.effect.0 ", "effect ")
        message = message.replace("one [[model.effect]]", "one --with")
        raise StudyError(message) from error
    if any(effect.alike(other) for other in setup.declared):
        raise refusal(
            file,
            f"effect {effect.key}",
            "an effect that the study or another --with declares at the same placement",
            "every effect once",
            "remove it, or change the declared effect with --set",
        )
    return effect


def parse_every_with(
    texts: Sequence[str],
    catalogue: Catalogue,
    setup: Setup,
    files: Mapping[str, str] = MappingProxyType({"": "data.csv"}),
) -> list[Effect]:
    """The effects of several texts, each placed together with the ones before it; raises
    `StudyError` as `parse_with` does.
    """
    found: list[Effect] = []
    for text in texts:
        found.append(parse_with(text, catalogue, beside(setup, *found), files))
    return found


def _value(text: str) -> int | float | str:
    if text in ("true", "false"):
        return text == "true"
    for kind in (int, float):
        try:
            return kind(text)
        except ValueError:
            pass
    return text


def check_noise_factor(factor: float) -> None:
    """Raise `StudyError` for a noise factor that is negative, too large or not a number."""
    if not 0.0 <= factor <= _MOST_NOISE:
        raise refusal(
            "--noise-factor",
            "value",
            f"{factor:g}",
            f"a number of at least 0 and at most {_MOST_NOISE:g}",
            "correct it",
        )


def write_simulated(
    study: Study,
    out: Path | str,
    *,
    effects: Sequence[Effect] = (),
    seed: int = 0,
    noise_factor: float = 1.0,
    overrides: Mapping[str, Any] | Sequence[str] = (),
) -> Simulated:
    """Write a copy of the folder of `study` with simulated data of a machine drawn from its priors.

    The study file and its tables are copied. The readings are replaced by simulated ones, the check
    points of linear axes by the true tool points at random positions over the travel. Tables that
    were read from a spreadsheet or with a mapping are written as CSV in vcal's own columns.
    ``truth.json`` holds all values of the simulated machine, those of the undeclared `effects`
    included; no other file holds them. The result depends on `seed` alone. With `overrides`, with
    which the study was read, the study file is written with these values and without its comments.

    Raises `StudyError` where `out` exists and is not empty, where a table lies outside the folder
    of the study, where the noise factor is not a number of at least 0, and where an identified
    position lies outside the travel.
    """
    out = Path(out)
    require_empty(out)
    check_noise_factor(noise_factor)
    for name in {*study.hashes, *study.files.values(), study.check_file}:
        if Path(name).is_absolute() or ".." in Path(name).parts:
            raise refusal(
                study.path.name,
                f"file {name}",
                "a file outside the folder of the study",
                "all files in the folder of the study, so that it can be copied",
                "move the file there",
            )
    machine, where = jax.random.split(jax.random.key(seed))
    result = _simulated(study, effects, machine, noise_factor)
    _check_travel(study, result)
    tables = {one.file: _data(study, one, result) for one in study.sets}
    for one in study.sets:
        _check_readable(study, one, tables[one.file])
    points = _check(study, result, where)
    if points is not None:
        tables[study.check_file] = points
    truth = _truth(study, result, effects, seed, noise_factor)
    with made_whole(out) as work:
        for name in study.hashes:
            (work / name).parent.mkdir(parents=True, exist_ok=True)
            if name not in tables:
                write_file(work / name, (study.folder / name).read_bytes())
        raw, _ = read_setup(study.path, overrides)
        own = with_own_tables(raw, tables)
        if overrides or own != raw:
            write_file(work / study.path.name, _setup(study, own))
        for name, table in tables.items():
            path = work / own_name(name)
            path.parent.mkdir(parents=True, exist_ok=True)
            write_table(path, table)
        write_file(work / "truth.json", json.dumps(truth, indent=1) + "\n")
    return result


def _simulated(
    study: Study, effects: Sequence[Effect], key: jax.Array, noise_factor: float
) -> Simulated:
    own = study.model
    model = Model(own.chain, own.instrument.as_declared(), (*own.effects, *own.random))
    try:
        return simulate(
            model,
            study.plan,
            key,
            effects=effects,
            noise_factor=noise_factor,
            name=study.name,
        )
    except ValueError as error:
        if isinstance(error, StudyError):
            raise
        # Priors or values of effects so large that the readings are not finite.
        raise refusal(
            study.path.name,
            "the simulated machine",
            f"readings that are not finite ({error})",
            "errors with finite readings",
            "declare smaller errors, or give --with smaller values",
        ) from error


def _setup(study: Study, raw: Mapping[str, Any]) -> str:
    """The study file as it was used for the simulation, for tables in vcal's own format."""
    head = (
        f"# Written by `vcal simulate` from {study.path.name}, with the values given by --set.\n\n"
    )
    return head + tomli_w.dumps(raw)


def _data(study: Study, one: DataSet, result: Simulated) -> dict[str, np.ndarray]:
    """The columns of a data set, with the positions and readings of the simulation."""
    plan, readings = result.measurement.plan, result.measurement.readings
    if one.name:
        width = len(one.instrument.readings)
        plan, readings = plan.part(one.name), readings[plan.in_set(one.name), :width]
    # A column keeps the name that it has in the file, such as T_X_degC.
    axes, own = study.chain.axes, one.table
    names = {inside_name(name, axes): name for name in own}
    made = {
        names.get(inside_name(name, axes), name): values
        for name, values in one.instrument.to_table(plan, readings).items()
    }
    # Internally, time counts from `start_s`; the table keeps its own clock.
    clock = {name: own[name] for name in ("t_s",) if name in own}
    return {**own, **{name: _in_place(own, name, values) for name, values in made.items()}, **clock}


def _in_place(table: Table, column: str, values: np.ndarray) -> np.ndarray:
    """A simulated column of the rows with readings, extended to all rows of the table.

    A reading that is blank in the table stays blank.
    """
    if not table.blank.any():
        return values
    values = np.asarray(values)
    if column in table and column not in table.read:
        whole = np.array(table[column])
    else:
        whole = np.full(table.rows, np.nan)
    whole[~table.blank] = values
    return whole


def _check(study: Study, result: Simulated, key: jax.Array) -> dict[str, np.ndarray] | None:
    """Check points: conditions at random positions, and the true tool point there.

    None for an arm, whose tool point only its instrument determines, and None where every
    instrument has columns of its own for positions, as it measures at one place. For several data
    sets, the conditions are those that all of them record.
    """
    chain, plan = study.chain, study.plan
    there = [one for one in study.sets if not one.instrument.positioned]
    if not there or chain.arm:
        return None
    if len(there) < len(study.sets):
        plan = plan.take(np.flatnonzero(np.any([plan.in_set(one.name) for one in there], axis=0)))
    kept = set.intersection(*(_conditions(study, one) for one in there))
    temperature_offset_K = study.sets[0].instrument.temperature_offset_K
    table = linear_plan_table(
        scattered(chain, plan, key, _CHECK_ROWS), temperature_offset_K=temperature_offset_K
    )
    table = {name: values for name, values in table.items() if name in kept}
    points = result.tool_points(
        linear_plan(chain, table, temperature_offset_K=temperature_offset_K)
    )
    return table | {f"tcp_{c}_mm": points[:, i] * 1e3 for i, c in enumerate("xyz")}


def _conditions(study: Study, one: DataSet) -> set[str]:
    """Columns of a table other than readings, by the names under which vcal writes them."""
    axes = study.chain.axes
    plain, full = (
        {c.name for c in one.instrument.columns(one.settings, axes, readings=readings)}
        for readings in (False, True)
    )
    header = {*one.table.header} - (full - plain)
    return {file_name(inside_name(column, axes), axes) for column in header}


def _check_travel(study: Study, result: Simulated) -> None:
    """Raise `StudyError` for an identified position outside the travel, as it could not be read."""
    position = np.asarray(result.measurement.plan.position)
    for i, joint in enumerate(study.chain.joints):
        low, high = joint.travel
        bad = (position[:, i] < low) | (position[:, i] > high)
        # Planned positions were checked when they were read.
        bad &= position[:, i] != np.asarray(study.plan.position)[:, i]
        if bad.any():
            row = int(np.argmax(bad))
            unit, si = ("deg", math.degrees(1.0)) if joint.turns else ("mm", 1e3)
            name, place = study.plan.place(row)
            raise refusal(
                study.files[name],
                f"row {place + 1}, axis {joint.name}",
                f"{position[row, i] * si:.10g} {unit} in the simulation, outside the travel",
                f"{low * si:.10g} to {high * si:.10g} {unit}",
                "plan this row further inside, or declare a longer travel",
            )


def _check_readable(study: Study, one: DataSet, table: Mapping[str, np.ndarray]) -> None:
    """Raise `StudyError` for a simulated reading outside the range of its column."""
    for column in one.instrument.columns(one.settings, study.chain.axes, readings=True):
        if one.instrument.read_by and column.name not in table:
            continue
        values = np.asarray(table[column.name], float)
        bad = ~((values >= column.low) & (values <= column.high) | one.table.blank)
        # Readings that are not part of a row are NaN.
        bad &= ~(np.isnan(values) & bool(one.instrument.read_by))
        if bad.any():
            row = int(np.argmax(bad))
            raise refusal(
                one.file,
                f"row {row + 1}, column {column.name}",
                f"{values[row]:.7g} in the simulation",
                f"a number from {column.low:.7g} to {column.high:.7g}",
                "declare smaller errors or less noise, or give --with smaller values",
            )


def _truth(
    study: Study, result: Simulated, effects: Sequence[Effect], seed: int, noise_factor: float
) -> dict[str, Any]:
    def described(effect: Effect) -> dict[str, Any]:
        values = {p.label: _rounded(value) for p, value in result.values(effect)}
        return {"effect": effect.name, "placement": effect.placement, **values}

    return {
        "seed": seed,
        "noise_factor": noise_factor,
        "undeclared": [described(effect) for effect in effects],
        "declared": [described(effect) for effect in (*study.model.effects, *study.model.random)],
    }


def _rounded(value: float) -> float:
    return float(f"{value:.10g}")
