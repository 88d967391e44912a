"""Effects that a study declares by name, with values where they are known."""

import dataclasses
import math
import re
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from ..bounds import Within
from ..distributions import CATALOGUE as DISTRIBUTIONS
from ..distributions import Univariate, distribution
from ..effects.base import Effect, Setup
from ..effects.data_set import OfDataSet
from ..effects.registry import CATALOGUE
from ..errors import StudyError
from ..instruments.conditions import file_name
from ..machine.parameters import Parameter, Prior
from ..model.forward import effect_terms
from ..registry import nearest
from ..units import in_name
from .folder import Folder
from .messages import listed, refusal, shown
from .settings import EffectSettings

_KIND = "distribution"
_INSIDE = f"{__name__.partition('.')[0]}."
_NAME = re.compile(r"[A-Za-z][A-Za-z0-9_]*")
"""Names that can be used in ``--with NAME:PLACEMENT``, in a key and in the name of a page."""
_UNIVARIATE = tuple(name for name, kind in DISTRIBUTIONS.items() if issubclass(kind, Univariate))
"""Distributions of one number, by name."""

Catalogue = Mapping[str, type[Effect]]

_BEYOND = 3.0
"""A declared amplitude may exceed by this factor what the loop takes to be possible
(`Parameter.largest`): an effect that it found may be declared."""
SHAPE_BOUNDS = {
    "mm": Within(1e-3, 1e5, "no screw, rack or scale repeats within a micrometre or over 100 m"),
    "um": Within(1e-2, 1e6, "no scale repeats within 10 nm or over a metre"),
    "deg": Within(1e-3, 1e4, "no gear repeats within 4 arcsec"),
    "mm/s": Within(1e-4, 1e4, "no guideway slides at a lower or a higher speed only"),
    "deg/s": Within(1e-4, 1e4, "no joint turns at a lower or a higher speed only"),
    "rad/s": Within(1e-6, 1e4, "no joint turns at a lower or a higher speed only"),
    "s": Within(1e-3, 1e8, "no machine settles within a millisecond or over years"),
    "min": Within(1e-5, 1e6, "no machine settles within a millisecond or over years"),
    "h": Within(1e-5, 1e5, "no machine settles within a tenth of a second or over years"),
}
"""Bounds of declared pitches, speeds and time constants by their unit."""
TIME_BOUNDS = {
    "s": Within(-1e10, 1e10, "300 years; seconds since 1970 have ten digits"),
    "min": Within(-1e9, 1e9, "2000 years"),
    "h": Within(-1e7, 1e7, "1000 years"),
}
"""Bounds of declared points of time by their unit."""


def catalogue_with(folder: Folder, effects_file: str | None) -> dict[str, type[Effect]]:
    """The built-in catalogue with the effects of a user's file, which is executed.

    Raises `StudyError` for a file that cannot be used, and for a name that another effect has.
    """
    known = dict(CATALOGUE)
    if effects_file is None:
        return known
    reserved = set(_names_inside(Effect))
    module = folder.module(effects_file, CATALOGUE.what)
    for effect in CATALOGUE.defined_in(module, Effect):
        if not _NAME.fullmatch(effect.name):
            raise refusal(
                effects_file,
                f"class {effect.__name__}",
                f"the name {effect.name!r}",
                "letters, digits and _, beginning with a letter",
                "rename the effect",
            )
        if effect.name in known or effect.name in reserved:
            raise refusal(
                effects_file,
                f"class {effect.__name__}",
                f"the name {effect.name!r}, which is taken",
                "a name that no other effect has",
                "rename the effect",
            )
        known[effect.name] = effect
    return known


def _names_inside(kind: type[Effect]) -> Iterator[str]:
    """Names of all effects of vcal, including those of instruments and empirical descriptions."""
    for one in kind.__subclasses__():
        if one.__module__.startswith(_INSIDE):
            yield getattr(one, "name", "")
        yield from _names_inside(one)


def unknown_effect(name: str, catalogue: Catalogue, file: str, key: str) -> StudyError:
    """The error to raise for a name that is not in the catalogue."""
    return refusal(
        file,
        f"key {key}",
        f"the unknown effect {name!r}{nearest(name, catalogue)}",
        f"one of {listed(sorted(catalogue), 60)}",
        "correct the name",
    )


def declared_effects(
    rows: Sequence[EffectSettings],
    catalogue: Catalogue,
    setup: Setup,
    file: str,
    data: Mapping[str, str],
) -> tuple[Effect, ...]:
    """The effects of the ``[[model.effect]]`` rows, placed on the machine of `setup`.

    A parameter with a value is known. A ``*_sigma`` gives it a normal prior, about its value or
    about zero. A table, such as ``{distribution = "uniform", low = 8, high = 12}``, gives it that
    distribution. A parameter that is not given keeps the prior of the catalogue. `file` is the name
    of the study file in messages, and `data` maps the name of every data set to its table. Raises
    `StudyError`.

    The rows are placed in order: an effect that corrects another one (`jerk_crosstalk` and
    `acceleration_crosstalk`) comes after it.
    """
    found: list[Effect] = []
    for i, row in enumerate(rows):
        where = _Where(file, f"model.effect.{i}", row.name)
        if row.name not in catalogue:
            raise unknown_effect(row.name, catalogue, file, f"{where.key}.name")
        own = _setup_of(row, catalogue[row.name], setup, where)
        effect = _declared(row, catalogue[row.name], own, where)
        _check_covariates(effect, own, where, data)
        if own.data_set and not effect.on_instrument:
            raise where.refusal(
                "data_set",
                repr(own.data_set),
                "no such key, as this effect belongs to the machine",
                "remove it",
            )
        placed = OfDataSet.of(effect, own.data_set) if own.data_set else effect
        if any(placed.alike(e) for e in found):
            raise refusal(
                file,
                f"key {where.key} ({placed.key})",
                "the same effect at the same place a second time",
                "one [[model.effect]] for each",
                "remove one of them",
            )
        found.append(placed)
        setup = beside(setup, placed)
    return tuple(found)


def beside(setup: Setup, *effects: Effect) -> Setup:
    """The setup with further declared effects, which other effects may refer to."""
    parts = tuple(beside(part, *effects) for part in setup.parts)
    return dataclasses.replace(setup, declared=(*setup.declared, *effects), parts=parts)


def _setup_of(row: EffectSettings, cls: type[Effect], setup: Setup, where: "_Where") -> Setup:
    """The setup for a declared effect: the machine, or the instrument of one of the data sets."""
    names = [part.data_set for part in setup.parts]
    if row.data_set is not None:
        if row.data_set not in names:
            raise where.refusal(
                "data_set",
                f"{row.data_set!r}{nearest(row.data_set, names)}",
                f"one of {listed(names)}" if names else "no such key, as there is one data set",
                "correct the name" if names else "remove the key",
            )
        return setup.parts[names.index(row.data_set)]
    fitting = [p for p in setup.parts if any(e.on_instrument for e in _tried(cls, p, where))]
    if not fitting or any(not e.on_instrument for e in _tried(cls, setup, where)):
        return setup
    if len(fitting) > 1:
        raise where.refusal(
            "data_set",
            "nothing",
            f"one of {listed(part.data_set for part in fitting)}, whose instrument has the effect",
            "add the name of the data set",
        )
    return fitting[0]


def _tried(cls: type[Effect], setup: Setup, where: "_Where") -> list[Effect]:
    """The instances of a class in a setup; raises `StudyError` where its own code fails."""
    try:
        return list(cls.candidates(setup))
    except Exception as error:
        raise _unplaced(cls, error, where) from error


def _unplaced(cls: type[Effect], error: Exception, where: "_Where") -> StudyError:
    return where.refusal(
        "",
        f"{type(error).__name__}: {error}, while it was placed",
        "a class whose `candidates` yields its instances",
        f"correct `candidates` of {cls.__name__}",
    )


@dataclasses.dataclass(frozen=True)
class _Where:
    """One row of [[model.effect]], for messages."""

    file: str
    key: str
    name: str

    def refusal(self, key: str, found: str, expected: str, do: str) -> StudyError:
        key = f"{self.key}.{key}" if key else self.key
        return refusal(self.file, f"key {key} ({self.name})", found, expected, do)


def _declared(row: EffectSettings, cls: type[Effect], setup: Setup, where: _Where) -> Effect:
    extra = dict(row.__pydantic_extra__ or {})
    options = _placed(row, cls, setup, where)
    if row.component is not None:
        options = _with_component(options, row.component, where)
    for key in list(extra):
        if key not in _fields(options[0]):
            continue
        values = _values(options, key)
        if not values:  # a chain, a basis, levers: values that a row cannot express
            raise _unknown_parameter([key], options, row.component, where)
        value = extra.pop(key)
        if value not in values:
            raise where.refusal(key, shown(value), f"one of {_either(values)}", "correct the value")
        options = [e for e in options if getattr(e, key) == value]
    laws = {key: value for key, value in extra.items() if isinstance(value, dict)}
    given = _spread({k: v for k, v in extra.items() if k not in laws}, options, where)
    keys = (*given, *laws)
    fitting = [
        (e, names)
        for e, names in ((e, _labels(e, row.component)) for e in options)
        if all(key.removesuffix("_sigma") in names or key in names for key in keys)
    ]
    if not fitting:
        raise _unknown_parameter(keys, options, row.component, where)
    fitting = _simplest(fitting)
    if len(fitting) > 1:
        raise _several_fit([e for e, _ in fitting], row.component, where)
    effect, names = fitting[0]
    return dataclasses.replace(
        effect,
        given=_given(given, names, where),
        priors=_priors(laws, given, names, where, effect.kind == "random"),
    )


def _simplest(fitting: list[tuple[Effect, dict]]) -> list[tuple[Effect, dict]]:
    """The effect whose parameters all others contain together with further ones that the row does
    not name; all effects where there is no such effect.
    """
    names = [{p.name for p in effect.parameters} for effect, _ in fitting]
    least = min(range(len(names)), key=lambda i: len(names[i]))
    within = all(names[least] < other for i, other in enumerate(names) if i != least)
    return [fitting[least]] if within else fitting


def _placed(row: EffectSettings, cls: type[Effect], setup: Setup, where: _Where) -> list[Effect]:
    """The instances of a class at the declared placement."""
    options = _tried(cls, setup, where)
    own = cls.candidates.__func__ is Effect.candidates.__func__  # type: ignore[attr-defined]
    if not options and own:
        try:
            options = [cls(placement=row.placement)]
        except Exception as error:
            raise _unplaced(cls, error, where) from error
    if not options:
        raise where.refusal(
            "name",
            "an effect without a possible placement on this machine and instrument",
            f"one that acts on the axes {listed(setup.chain.axes)} or on this instrument, and a "
            "correction of another effect after that effect",
            "remove it, declare the corrected effect first, or correct the machine or the "
            "instrument",
        )
    placements = list(dict.fromkeys(e.placement for e in options))
    if row.placement in placements:
        return [e for e in options if e.placement == row.placement]
    if not row.placement and len(placements) == 1:
        return options
    raise where.refusal(
        "placement",
        f"{row.placement!r}{nearest(row.placement, placements)}" if row.placement else "nothing",
        f"one of {listed(p or '(none)' for p in placements)}",
        "correct the placement" if row.placement else "add the placement",
    )


def _with_component(options: list[Effect], component: str, where: _Where) -> list[Effect]:
    matching = [e for e in options if component in _texts(e)]
    if not matching:
        known = list(dict.fromkeys(text for e in options for text in _texts(e)))
        raise where.refusal(
            "component",
            f"{component!r}{nearest(component, known)}",
            f"one of {listed(known)}" if known else "no component",
            "correct the component" if known else "remove the key",
        )
    return matching


def _texts(effect: Effect) -> list[str]:
    """Texts among the fields of an effect: its ports, error motions, angles, other axes."""
    values: list[str] = []
    for field in dataclasses.fields(effect):
        value = getattr(effect, field.name)
        if field.name in ("placement", "given", "priors", "unit"):
            continue
        values += [value] if isinstance(value, str) else []
    return values


def _fields(effect: Effect) -> list[str]:
    """The fields of a class beyond those of every effect."""
    names = [field.name for field in dataclasses.fields(effect)]
    return [name for name in names if name not in ("placement", "given", "priors")]


def _values(options: Sequence[Effect], key: str) -> list[Any]:
    """The distinct values of a field in these effects; none where a row cannot express them."""
    values = [getattr(e, key) for e in options]
    values = [value.item() if isinstance(value, np.generic) else value for value in values]
    if not all(isinstance(value, str | int | float) for value in values):
        return []
    return list(dict.fromkeys(values))


def choices(effect: Effect, setup: Setup) -> dict[str, list[Any]]:
    """Keys that a row needs in addition to the placement, with their possible values.

    The effects of this class and placement differ in these fields; a field that follows from the
    fields before it is left out.
    """
    options = [e for e in type(effect).candidates(setup) if e.placement == effect.placement]
    found: dict[str, list[Any]] = {}
    known: list[tuple[Any, ...]] = [() for _ in options]
    for key in _fields(effect) if options else []:
        values = _values(options, key)
        if len(values) < 2 or key == "unit":  # a unit follows from the component
            continue
        more = [(*one, getattr(e, key)) for one, e in zip(known, options, strict=True)]
        if len(set(more)) == len(set(known)):
            continue
        known = more
        named = "component" not in found and all(isinstance(value, str) for value in values)
        found["component" if named else key] = values
    return found


def _chosen(options: Sequence[Effect], key: str) -> bool:
    """Whether a field is a number in which these effects differ."""
    values = _values(options, key)
    return len(values) > 1 and not any(isinstance(value, str) for value in values)


def _either(values: Sequence[Any]) -> str:
    return listed(value if isinstance(value, str) else shown(value) for value in values)


def _several_fit(options: Sequence[Effect], component: str | None, where: _Where) -> StudyError:
    """The error to raise where several effects fit a row; it asks for the first key in which they
    differ.
    """
    found = f"{len(options)} effects that these keys fit"
    for key in _fields(options[0]):
        values = _values(options, key)
        if len(values) < 2:
            continue
        if component is None and key != "unit" and all(isinstance(v, str) for v in values):
            key = "component"
        expected = f"one, by its {key}: {_either(values)}"
        return where.refusal(key, found, expected, f"add the {key}")
    labels = listed(dict.fromkeys(p.label for e in options for p in e.parameters))
    return where.refusal("", found, f"one, by its parameters: {labels}", "add one of them")


def _labels(effect: Effect, component: str | None) -> dict[str, Parameter]:
    """Parameters by key: name with unit, also without the component in it (``k_urad_per_K``)."""
    named = {p.label: p for p in effect.parameters}
    for p in effect.parameters:
        for text in (component, *_texts(effect)):
            short = p.name.removesuffix(f"_{text}")
            if short != p.name:
                named.setdefault(dataclasses.replace(p, name=short).label, p)
    return named


def _spread(extra: Mapping[str, Any], options: Sequence[Effect], where: _Where) -> dict[str, float]:
    """Numbers by key; a list or matrix is one key per X, Y, Z: ``matrix_XY_...`` for [0][1]."""
    units = {in_name(p.unit) for e in options for p in e.parameters}
    given: dict[str, float] = {}
    for key, value in extra.items():
        if not isinstance(value, list):
            given[key] = _number(key, value, where)
            continue
        sigma = "_sigma" if key.endswith("_sigma") else ""
        plain = key.removesuffix("_sigma")
        unit = max((u for u in units if plain.endswith(f"_{u}")), key=len, default="")
        stem = plain.removesuffix(f"_{unit}")
        try:
            array = np.asarray(value, float)
        except (TypeError, ValueError):
            array = np.zeros((0,))
        if array.ndim == 0 or array.size == 0 or set(array.shape) != {3}:
            raise where.refusal(
                key, shown(value), "a number, three numbers or a 3 x 3 matrix", "correct the value"
            )
        for index in np.ndindex(array.shape):
            name = f"{stem}_{''.join('XYZ'[i] for i in index)}_{unit}{sigma}"
            given[name] = float(array[index])
    return given


def _number(key: str, value: Any, where: _Where) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise where.refusal(key, shown(value), "a number", "correct the value")
    if key.endswith("_sigma") and value < 0:
        raise where.refusal(key, f"{value:g}", "a number of at least 0", "correct the value")
    return float(value)


def _unknown_parameter(
    given: Sequence[str], options: Sequence[Effect], component: str | None, where: _Where
) -> StudyError:
    known = list(dict.fromkeys(label for e in options for label in _labels(e, component)))
    others = ["placement"] if any(e.placement for e in options) else []
    others += ["component"] if any(map(_texts, options)) else []
    others += [key for key in _fields(options[0]) if _chosen(options, key)]
    for key in given:
        if key.removesuffix("_sigma") not in known and key not in known:
            plain = key.removesuffix("_sigma")
            return where.refusal(
                key,
                f"the unknown key {key!r}{nearest(plain, [*known, *others])}",
                "".join(f"{other}, " for other in others)
                + ("or " if others else "")
                + f"one of {listed(known)} (and with _sigma)",
                "correct or remove the key",
            )
    return where.refusal(
        "",
        f"the keys {listed(given)}, which belong to different effects",
        "parameters of one effect",
        "write one [[model.effect]] for each component",
    )


def _given(
    given: Mapping[str, float], names: Mapping[str, Parameter], where: _Where
) -> tuple[tuple[str, float, float], ...]:
    values: dict[str, dict[str, float]] = {}
    for key, value in given.items():
        part = "mean" if key in names else "sigma"
        p = names[key if key in names else key.removesuffix("_sigma")]
        if part == "sigma" and p.shape:
            raise where.refusal(
                key,
                f"{value:g}",
                f"no sigma: {p.name} is known if it is given, and identified if it is not",
                "remove the key",
            )
        if p.shape and p.coordinate != "linear" and value <= 0.0:
            raise where.refusal(key, f"{value:g}", "a number greater than 0", "correct the value")
        _check_size(key, value, p, where)
        if part in values.setdefault(p.name, {}):
            raise where.refusal(
                key, f"{p.name} given twice", "every parameter once", "remove one of the keys"
            )
        values[p.name][part] = value
    return tuple((n, v.get("mean", 0.0), v.get("sigma", 0.0)) for n, v in values.items())


def _check_size(key: str, value: float, p: Parameter, where: _Where) -> None:
    """Raise `StudyError` for a value that no machine has: an amplitude of many times the size that
    the catalogue expects, a pitch below a micrometre.
    """
    within = bound_of(p)
    if within is None or within.holds(value) or value == math.inf:
        return
    raise where.refusal(
        key, f"{value:g}", within.expected(value), f"correct the value or its unit: {within.why}"
    )


def bound_of(p: Parameter) -> Within | None:
    """The bound of a declared value of a parameter, in its unit; None for a parameter whose
    expected size is not known.
    """
    if p.shape:
        return SHAPE_BOUNDS.get(p.unit) if p.coordinate != "linear" else TIME_BOUNDS.get(p.unit)
    if not p.informed or not p.sigma > 0.0:
        return None
    times = _BEYOND * p.largest
    most = abs(p.mean) + times * p.sigma
    return Within(-most, most, f"{times:g} times the expected size is no error of this kind")


def _priors(
    laws: Mapping[str, Mapping[str, Any]],
    given: Mapping[str, float],
    names: Mapping[str, Parameter],
    where: _Where,
    random: bool,
) -> tuple[Prior, ...]:
    """Distributions of parameters: ``alpha_um_per_m_K = {distribution = "uniform", ...}``."""
    found, taken = [], {names[k.removesuffix("_sigma")].name for k in given}
    for key, law in laws.items():
        if key not in names:
            raise where.refusal(
                key, shown(law), "a number, as every `_sigma`", "remove `_sigma` from the key"
            )
        name = names[key].name
        if name in taken:
            raise where.refusal(
                key, f"{name} given twice", "every parameter once", "remove one of the keys"
            )
        taken.add(name)
        kind = law.get(_KIND)
        if not isinstance(kind, str):
            raise where.refusal(
                f"{key}.{_KIND}",
                "nothing" if kind is None else shown(kind),
                f"one of {listed(_UNIVARIATE)}",
                'write it such as {distribution = "uniform", low = 8, high = 12}',
            )
        if kind not in _UNIVARIATE:
            raise where.refusal(
                f"{key}.{_KIND}",
                f"{kind!r}{nearest(kind, _UNIVARIATE)}",
                f"one of {listed(_UNIVARIATE)}",
                "correct the name",
            )
        try:
            prior = Prior(name, distribution(kind, **{k: v for k, v in law.items() if k != _KIND}))
            mean, sigma = float(prior.mean[0]), float(prior.sigma[0])
        except (StudyError, ValueError) as error:
            raise where.refusal(
                key, f"{shown(law)}, which cannot be used", str(error), "correct it"
            ) from error
        for number in (mean, sigma):
            _check_size(key, number, names[key], where)
        if random and mean != 0.0:
            raise where.refusal(
                key,
                f"a distribution with the mean {mean:g}",
                "the mean zero, as this effect is a scatter",
                "centre the distribution",
            )
        found.append(prior)
    return tuple(found)


def _check_covariates(effect: Effect, setup: Setup, where: _Where, data: Mapping[str, str]) -> None:
    """Raise `StudyError` where a declared effect cannot be computed: without a recorded covariate,
    for a missing port, or without finite deviations.
    """
    plan = setup.plan
    missing = [name for name in effect.needs if not plan.has(name)]
    if missing:
        column = file_name(missing[0], plan.axes)
        lacking = [data[name] for name in plan.lacking(missing[0])]
        shared = not plan.sets or bool(lacking)
        found = "no such column" if shared else "one in each that is not that of the others"
        raise refusal(
            data[setup.data_set] if setup.data_set in data else listed(lacking or data.values()),
            f"column {column}",
            f"{found}, but the declared effect {effect.key!r} ({where.key} of "
            f"{where.file}) depends on it",
            f"the columns {listed(file_name(name, plan.axes) for name in effect.needs)}"
            + ("" if shared else ", the same in all data sets"),
            "add the column or remove the effect"
            if shared
            else "give the start of each data set as start_s, or remove the effect"
            if missing[0] == "t"
            else "remove the effect",
        )
    try:
        shape = {
            p.name: p.mean * p.si if p.name in {n for n, *_ in effect.given} else math.nan
            for p in effect.shapes
        }
        terms = effect_terms(effect, setup.layout, plan, shape)
    except Exception as error:
        raise where.refusal(
            "",
            f"{type(error).__name__}: {error}, while its response was computed",
            "deviations of ports that this machine and instrument have",
            f"correct {type(effect).__name__}, or remove the effect",
        ) from error
    numbers = np.concatenate([terms.offset, terms.values], axis=1)
    if np.isfinite(list(shape.values())).all() and not np.isfinite(numbers).all():
        row = int(np.argmin(np.isfinite(numbers).all(1)))
        values = ", ".join(f"{name} {mean:g}" for name, mean, _ in effect.given) or "nothing given"
        raise where.refusal(
            "",
            f"no finite deviation in row {setup.plan.row_name(row)} with {values}",
            "values that give a finite deviation in every row",
            "correct the values",
        )
