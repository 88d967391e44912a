"""A study: the machine, instrument, model and data of one folder, read, checked and built."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from ..effects.base import Effect
from ..effects.registry import CATALOGUE
from ..instruments.base import Instrument
from ..machine.chain import Chain
from ..machine.plan import Plan
from ..model.forward import Model
from ..model.measurement import CheckPoints, Measurement
from ..numerics.spatial import require_float64
from ..registry import nearest
from ..words import counted, plural, printable
from .consent import require_inside
from .csv_table import Table
from .data_sets import DataSet, data_sets, together
from .declared_chain import build_chain
from .declared_effects import catalogue_with, declared_effects, unknown_effect
from .determined import check_determined, check_fitted, check_size
from .folder import Folder
from .geometric_family import geometric_errors
from .hold_out import held_out
from .messages import listed, refusal, source
from .must_see import check_identifiable
from .plugins.effects import check_own
from .previous_campaign import with_posterior
from .settings import (
    AnySettings,
    LoopSettings,
    StudySettings,
    table_formats,
    validate,
)
from .tables import check_points
from .toml_file import read_setup


@dataclass(frozen=True)
class Study:
    """A machine, its instruments, the declared model of their errors, and the measurement."""

    name: str
    path: Path
    """The study file."""
    settings: AnySettings
    """The settings of the study file, with overrides and defaults."""
    chain: Chain
    sets: tuple[DataSet, ...]
    """The data set, or those of the ``[[data]]`` rows."""
    instrument: Instrument
    """The instrument of all data sets together, with starting values from the readings."""
    model: Model
    """The declared model: geometric errors, effects of the instrument, declared effects."""
    plan: Plan
    measurement: Measurement | None
    """The readings with their plan; None for a table without columns of readings."""
    check: CheckPoints | None
    """Independent check points; None without any."""
    catalogue: Mapping[str, type[Effect]]
    """Effects by name that the loop may test, including those of the user's own file."""
    hashes: Mapping[str, str]
    """SHA-256 of every input file by name."""
    tables: Mapping[str, Table] = field(default_factory=dict)
    """Every table as it was read, by the name that the study gives it."""
    trust: bool = False
    """Whether the Python files that it names may be run."""
    allow_outside: bool = False
    """Whether files outside its folder may be read."""

    def __repr__(self) -> str:
        kinds = ", ".join(one.settings.kind for one in self.sets)
        readings = "no readings" if self.measurement is None else f"{self.plan.rows} rows"
        check = "" if self.check is None else f", {self.check.plan.rows} check points"
        return f"Study({self.name!r}: {self.chain.text}, {kinds}, {readings}{check})"

    @property
    def single(self) -> StudySettings:
        """The settings of a study of one data set.

        Raises `StudyError` for several data sets, for callers that need a single one.
        """
        if isinstance(self.settings, StudySettings):
            return self.settings
        raise refusal(
            self.path.name,
            "key data",
            f"{len(self.sets)} [[data]] rows ({listed(one.name for one in self.sets)})",
            "a single data set, as `vcal design` supports only one",
            "write a study of one of them, with its [instrument]",
        )

    @property
    def one(self) -> DataSet:
        """The data set of a study of one data set; raises `StudyError` as `single` does."""
        _ = self.single
        return self.sets[0]

    @property
    def observers(self) -> tuple[str, str]:
        """``"Instrument"`` or ``"Instruments"``, and their kinds in words."""
        return plural(len(self.sets), "Instrument"), "; ".join(one.label for one in self.sets)

    @property
    def observations(self) -> str:
        """Numbers of observations and of readings, in words."""
        return "; ".join(
            f"{counted(one.plan.rows, 'observation')} of "
            f"{counted(len(one.instrument.readings), 'reading')}"
            + (f" ({count} more with a blank reading left out)" if count else "")
            for one in self.sets
            for count in [len(one.table.blank_rows)]
        )

    @property
    def files(self) -> dict[str, str]:
        """The table of every data set by its name; by the empty name for a single data set."""
        return {one.name: one.file for one in self.sets}

    @property
    def check_file(self) -> str:
        """Name of the table of check points, which need not exist."""
        return _check_given(self.settings) or "check.csv"

    @property
    def folder(self) -> Path:
        """The folder of the study file and of its tables."""
        return self.path.parent

    @property
    def options(self) -> LoopSettings:
        """Settings of the loop."""
        return self.settings.loop

    @property
    def tried(self) -> list[type[Effect]]:
        """The effects that the loop tests: those named in its settings, or the whole catalogue."""
        if self.options.effects:
            return [self.catalogue[name] for name in self.options.effects]
        return list(self.catalogue.values())

    @property
    def as_dict(self) -> dict[str, Any]:
        """The settings as plain values, for reports."""
        return self.settings.model_dump()


def load_study(
    path: Path | str,
    overrides: Mapping[str, Any] | Sequence[str] = (),
    *,
    trust: bool = False,
    allow_outside: bool = False,
) -> Study:
    """Read a study file, or the ``setup.toml`` of a folder, and all files that it names.

    `overrides` replace keys before the checks: texts such as ``"instrument.joints=read"``, or a
    mapping of keys to values. Python files with effects and instruments of the user's own are run
    with `trust`, where they lie in a folder that the user's settings trust, or where the same
    contents were trusted before at this path. Other files must lie in the folder of the study,
    unless `allow_outside` is set. Raises `StudyError` for every mistake in the input, and
    `RuntimeError` where JAX runs in float32.
    """
    study, folder, given = _declared(path, overrides, trust, allow_outside)
    settings, model, measurement = study.settings, study.model, study.measurement
    file, data = study.path.name, listed(study.files.values())
    check_size(model, study.plan, data, measurement is not None)
    check_determined(model, study.plan, data)
    if measurement is not None:
        headers = {one.name: tuple(one.table) for one in study.sets}
        chosen = held_out(settings.holdout, model, measurement, file, headers)
        measurement = replace(measurement, holdout=chosen)
        check_fitted(model, measurement, data, settings.holdout is not None)
    _check_seen(settings, study.sets, file)
    check = _checked(settings, study.chain, study.sets, folder)
    _check_formats(settings, folder, file)
    return replace(
        study, measurement=measurement, check=check, hashes=folder.hashes, tables=folder.tables
    )


def declared_model(
    path: Path | str, overrides: Mapping[str, Any] | Sequence[str] = ()
) -> tuple[Model, Plan]:
    """The declared model of a study with its plan, without the checks that the readings determine
    it, which take compilations. Raises as `load_study` does.
    """
    study, _, _ = _declared(path, overrides)
    return study.model, study.plan


def _declared(
    path: Path | str,
    overrides: Mapping[str, Any] | Sequence[str],
    trust: bool = False,
    allow_outside: bool = False,
) -> tuple[Study, Folder, Mapping[str, str]]:
    """A study as it is declared, without hold-out and check points; the folder that it is read
    from; and where overrides were given.
    """
    require_float64()
    path = Path(path)
    if path.is_dir():
        path = path / "setup.toml"
    file = path.name
    folder = Folder(path.parent, trust, allow_outside)
    require_inside(folder.root, file, allowed=allow_outside)
    raw, given = read_setup(path, overrides)
    folder.path(file)
    folder.keys.update(_naming(raw, file))
    settings = validate(raw, file, given, folder)
    for name, key in _naming(settings.model_dump(by_alias=True), file, " by default").items():
        folder.keys.setdefault(name, key)
    folder.formats.update(table_formats(settings, file))
    catalogue = catalogue_with(folder, settings.model.effects_file)
    _check_wanted(settings.loop.effects or (), catalogue, file, given)
    chain = build_chain(settings.machine, file, folder)
    sets = data_sets(settings, chain, folder, file)
    instrument, plan, readings = together(sets, chain)
    measurement = None
    if readings is not None:
        blank = {one.file: rows for one in sets if (rows := one.table.blank_rows)}
        measurement = Measurement(
            plan, readings, printable(settings.name or path.parent.name, lines=False), blank=blank
        )
    model = Model(chain, instrument)
    if settings.model.geometric is not None:
        errors: Effect = geometric_errors(settings.model.geometric, chain, folder, file)
        if settings.model.previous is not None:
            errors = with_posterior(errors, settings.model.previous, chain, folder, file)
        model = model.with_effects(errors)
    elif settings.model.previous is not None:
        raise refusal(
            file,
            "key model.from",
            "it without [model.geometric]",
            "the [model.geometric] of that campaign",
            "add it, or remove the key",
        )
    model = model.with_effects(*instrument.effects(plan))
    files = {one.name: one.file for one in sets}
    model = model.with_effects(
        *declared_effects(settings.model.effect, catalogue, model.setup(plan), file, files)
    )
    if settings.model.effects_file is not None:
        own = {name: kind for name, kind in catalogue.items() if name not in CATALOGUE}
        check_own(settings.model.effects_file, own, model.setup(plan), plan)
    if not model.entries:
        raise refusal(
            file,
            "tables instrument and model",
            "no parameter, neither of the machine, nor of an effect, nor of the instrument",
            "at least one parameter to identify",
            "add [model.geometric] or an effect",
        )
    study = Study(
        name=printable(settings.name or path.resolve().parent.name, lines=False),
        path=path,
        settings=settings,
        chain=chain,
        sets=sets,
        instrument=instrument,
        model=model,
        plan=plan,
        measurement=measurement,
        check=None,
        catalogue=catalogue,
        hashes=folder.hashes,
        trust=trust,
        allow_outside=allow_outside,
    )
    return study, folder, given


def _naming(tree: Any, file: str, how: str = "") -> dict[str, str]:
    """The key of every text in the tree of a study file, in words, by the text; and by the text
    without a sheet (``run.xlsx#check``). The first key of a text counts.
    """
    found: dict[str, str] = {}
    stack = [("", tree)]
    while stack:
        key, value = stack.pop()
        if isinstance(value, str):
            for name in (value, value.rpartition("#")[0]):
                found[name] = f"key {key} of {file}{how}"
        elif isinstance(value, Mapping | list | tuple):
            items = value.items() if isinstance(value, Mapping) else enumerate(value)
            stack += [(f"{key}.{part}" if key else str(part), inner) for part, inner in items]
    found.pop("", None)
    return found


def looked_for(kind: type[Effect]) -> bool:
    """Whether the loop may name an effect; others can only be declared."""
    return kind.kind == "systematic" and kind.candidates.__func__ is not Effect.candidates.__func__


def _check_wanted(
    names: Sequence[str],
    catalogue: Mapping[str, type[Effect]],
    file: str,
    overrides: Mapping[str, str],
) -> None:
    """Effects that are to be tried must be known, and such as the loop looks for."""
    for i, name in enumerate(names):
        if name in catalogue and looked_for(catalogue[name]):
            continue
        where = source(file, "loop.effects", overrides)
        choice = {n: kind for n, kind in catalogue.items() if looked_for(kind)}
        if name in catalogue:
            raise refusal(
                where,
                f"key loop.effects.{i}",
                f"{name!r}, which can only be declared",
                f"one of {listed(sorted(choice), 60)}",
                "leave it out",
            )
        plain = name.partition(":")[0]
        if plain in choice:
            raise refusal(
                where,
                f"key loop.effects.{i}",
                repr(name),
                f"the name alone, {plain!r}: the loop tries it at every place",
                "correct the name",
            )
        raise unknown_effect(name, choice, where, f"loop.effects.{i}")


def _check_seen(settings: AnySettings, sets: Sequence[DataSet], file: str) -> None:
    """Raise `StudyError` where a table alone does not identify its ``must_see`` errors."""
    if isinstance(settings, StudySettings):
        wanted = {"data.must_see": settings.data.must_see}
    else:
        wanted = {f"data.{i}.must_see": row.must_see for i, row in enumerate(settings.data)}
    for (key, errors), one in zip(wanted.items(), sets, strict=True):
        check_identifiable(errors, one.chain, one.instrument, one.plan, file, key)


def _check_formats(settings: AnySettings, folder: Folder, file: str) -> None:
    """Raise `StudyError` for a declared table that no key of the study names."""
    for name in settings.tables:
        if name not in folder.tables:
            raise refusal(
                file,
                f"key tables.{name}",
                f"a table that the study does not read{nearest(name, folder.tables)}",
                f"one of {listed(folder.tables)}",
                "correct the name, or remove the table",
            )


def _checked(
    settings: AnySettings, chain: Chain, sets: Sequence[DataSet], folder: Folder
) -> CheckPoints | None:
    """The check points of the named table, or of ``check.csv`` where it exists; None otherwise."""
    given = _check_given(settings)
    name = given or "check.csv"
    if given is None and not folder.has(name):
        return None
    return check_points(name, sets[0].instrument, sets[0].settings, chain, folder)


def _check_given(settings: AnySettings) -> str | None:
    """The name of the table of check points in the study file, if it names one."""
    return settings.data.check if isinstance(settings, StudySettings) else settings.check
