"""The bundled start studies: copies for `vcal init`, and examples of effects on them."""

import dataclasses
import functools
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from ..demo import STARTS, starts
from ..effects import CATALOGUE
from ..effects.base import Effect, Setup
from ..errors import StudyError
from ..files import write_file
from ..machine.plan import Plan
from ..registry import nearest
from ..study.declared_chain import build_chain
from ..study.declared_effects import beside
from ..study.folder import Folder, made_whole, require_empty
from ..study.messages import listed
from ..study.settings import StudySettings, table_formats, validate
from ..study.study import declared_model
from ..study.tables import run_table
from ..study.toml_file import read_setup


def write_start(instrument: str, out: Path) -> list[str]:
    """Copy the start study of an instrument to `out`; returns the names of the files written.

    Raises `StudyError` for an instrument without a start study, and for a folder that is not empty.
    """
    known = starts()
    if instrument not in known:
        raise StudyError(
            f"--instrument: found {instrument!r}{nearest(instrument, known)}, expected one of "
            f"{listed(known)}; correct the name"
        )
    require_empty(out)
    names = []
    with made_whole(out) as work:
        for entry in (STARTS / instrument).iterdir():
            write_file(work / entry.name, entry.read_bytes())
            names.append(entry.name)
    return sorted(names)


def plans_in(folder: Path) -> dict[str, bool]:
    """The tables of a study folder, each with whether it is a plan, that is, without readings."""
    path = folder / "setup.toml"
    raw, given = read_setup(path)
    root = Folder(folder)
    settings = validate(raw, path.name, given, root)
    root.formats.update(table_formats(settings, path.name))
    chain = build_chain(settings.machine, path.name, root)
    if isinstance(settings, StudySettings):
        tables = [(settings.data.table, settings.instrument)]
    else:
        tables = [(row.file, row.instrument) for row in settings.data]
    return {
        name: not run_table(name, instrument, chain, root, path.name, "")[1]
        for name, instrument in tables
    }


def example(effect: type[Effect]) -> tuple[Effect, Setup] | None:
    """An instance of an effect on a bundled study that has a place and the columns for it.

    Where no study has all columns, the missing ones are added; an effect that acts on another
    effect is placed together with the others of the catalogue. None without any such place. Raises
    `RuntimeError` where JAX runs in float32.
    """
    wanting: list[tuple[Effect, Setup]] = []
    for setup in _setups():
        for instance in _instances(effect, setup):
            if setup.plan.has(*instance.needs):
                return instance, setup
            wanting.append((instance, setup))
    for instance, setup in wanting:
        fuller = dataclasses.replace(setup, plan=_with_columns(setup.plan, instance.needs))
        for found in _instances(effect, fuller):
            if fuller.plan.has(*found.needs):
                return found, fuller
    for setup in _setups():
        others = (next(iter(_instances(one, setup)), None) for one in CATALOGUE.values())
        together = beside(setup, *(one for one in others if one is not None))
        for instance in _instances(effect, together):
            if setup.plan.has(*instance.needs):
                return instance, together
    return None


def _setups() -> Iterator[Setup]:
    """The setups of the bundled studies; a study is read when it is asked for."""
    yield from map(_setup, starts())
    # Joint positions that are read back have effects of their own.
    yield _setup("reflectors", (("instrument.joints", "read"),))


def _instances(effect: type[Effect], setup: Setup) -> list[Effect]:
    """The candidates of a class in a setup; its single instance for a class without candidates,
    where the setup has its ports.
    """
    if effect.candidates.__func__ is not Effect.candidates.__func__:  # type: ignore[attr-defined]
        return list(effect.candidates(setup))
    instance = effect()
    ports = {port for port, _ in instance.response(setup.plan, {})}
    return [instance] if ports <= {*setup.layout.names} else []


@functools.cache
def _setup(instrument: str, changed: tuple[tuple[str, str], ...] = ()) -> Setup:
    model, plan = declared_model(STARTS / instrument, dict(changed))
    return model.setup(plan)


def _with_columns(plan: Plan, needs: Sequence[str]) -> Plan:
    """The plan with the missing columns added, with usual values for an effect to act on."""
    share = np.arange(plan.rows) / plan.rows
    usual = {
        "speed_rpm": 6000.0 * ((share > 0.1) & (share < 0.6)),
        "approach_rad": 2.0 * np.pi * np.mod(0.381966 * np.arange(plan.rows), 1.0),
        "payload_kg": 40.0 * np.round(share * 4.0) / 4.0,
        "t": 10.0 * np.arange(plan.rows),
    }
    other = np.sin(2.399963 * np.arange(plan.rows))
    added = {name: usual.get(name, other) for name in needs if not plan.has(name)}
    return Plan(plan.axes, plan.position, {**plan.covariates, **added}, plan.groups)
