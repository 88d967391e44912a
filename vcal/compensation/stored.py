"""An identified machine as a record for programs, and back: ``machine.json``.

The record states what a person or another program may want to read in stated units (machine,
effects, parameters with value and uncertainty, their covariance), and beside it the objects from
which the machine is made again without its measurement (`vcal.numerics.stored`).
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from ..effects.base import Effect
from ..machine.chain import Chain
from ..machine.parameters import Parameter
from ..machine.plan import Plan
from ..numerics.stored import NotStoredError, Reader, Writer
from .machine import IdentifiedMachine, Range, Rival
from .parts import part_names

SCHEMA = "vcal-machine/1"


def entries(machine: IdentifiedMachine) -> list[tuple[str, Parameter, float]]:
    """Effect with place, parameter, and SI per solver unit of every entry of `theta`: amplitudes,
    then fitted shape parameters.
    """
    named = list(zip(part_names(machine.effects), machine.effects, strict=True))
    found = [(name, p, p.step) for name, effect in named for p in effect.amplitudes]
    moving = [(name, p) for name, effect in named for p in effect.shapes if p.moves]
    steps = machine.shape_steps
    return [*found, *((name, p, s) for (name, p), s in zip(moving, steps, strict=True))]


def machine_record(machine: IdentifiedMachine) -> dict[str, Any]:
    """The machine as plain values; see `SCHEMA`.

    An effect whose class is not part of vcal is named, and cannot be made again.
    """
    writer = Writer()
    listed = entries(machine)
    units = np.array([step / p.si for _, p, step in listed])
    chain = machine.chain
    objects = {
        "chain": writer.plain(chain),
        "effects": _effects(writer, machine.effects),
        "random": _effects(writer, machine.random),
        "theta": writer.plain(machine.theta),
        "shape_steps": writer.plain(machine.shape_steps),
        "prior": writer.plain(machine.prior),
        "rivals": [
            {
                "averaged": rival.averaged,
                "found": _bare(writer, rival.found),
                "others": [{"probability": p, **_bare(writer, other)} for p, other in rival.others],
            }
            for rival in machine.rivals
        ],
        "check": _check(writer, machine),
    }
    same = np.array_equal(machine.covariance, machine.planned)
    return {
        "schema": SCHEMA,
        "name": machine.name,
        "date": machine.date,
        "machine": chain.text,
        "axes": list(machine.axes),
        "working_volume": [
            {
                "axis": axis,
                "low": float(low),
                "high": float(high),
                "unit": "rad" if j.turns else "m",
            }
            for axis, j, (low, high) in zip(machine.axes, chain.joints, machine.volume, strict=True)
        ],
        "tool_offset_mm": [1e3 * float(v) for v in np.asarray(chain.tool_offset)],
        "temperature_offset_K": machine.temperature_offset_K,
        "conditions": {
            name: {"low": one.low, "mean": one.mean, "high": one.high}
            for name, one in machine.ranges.items()
        },
        "no_gain": machine.no_gain,
        "about": {name: dict(table) for name, table in machine.about.items()},
        "parameters": [
            {
                "effect": name,
                "parameter": p.name,
                "unit": p.unit,
                "value": _value(machine, i, p, step),
                "standard_uncertainty": math.sqrt(max(machine.covariance[i, i], 0.0)) * unit,
            }
            for i, ((name, p, step), unit) in enumerate(zip(listed, units, strict=True))
        ],
        "shapes": [
            {"effect": name, "values_si": {key: float(v) for key, v in shape.items()}}
            for name, shape in zip(part_names(machine.effects), machine.shapes, strict=True)
        ],
        "covariance": _triangle(machine.covariance, units),
        "planned_covariance": None if same else _triangle(machine.planned, units),
        "instrument_ports": list(machine.instrument_ports),
        "objects": {**objects, "records": writer.records, "arrays": writer.arrays},
    }


def machine_from(record: Mapping[str, Any]) -> IdentifiedMachine:
    """The machine of a record. Raises `NotStoredError` for an effect that cannot be made again,
    with its name, and for a record that is not complete.
    """
    try:
        return _machine_from(record)
    except NotStoredError:
        raise
    except (KeyError, IndexError, TypeError, ValueError, AttributeError) as error:
        raise NotStoredError(f"a record that is not complete ({error})") from error


def _machine_from(record: Mapping[str, Any]) -> IdentifiedMachine:
    objects = record["objects"]
    reader = Reader(objects["records"], objects["arrays"])
    chain = reader.value(objects["chain"])
    if not isinstance(chain, Chain):
        raise NotStoredError("a chain that is none")
    theta = np.asarray(reader.value(objects["theta"]), float)
    bare = IdentifiedMachine(
        chain=chain,
        effects=_effects_from(reader, objects["effects"]),
        theta=theta,
        shapes=tuple(dict(one["values_si"]) for one in record["shapes"]),
        shape_steps=reader.value(objects["shape_steps"]),
        covariance=np.zeros((len(theta), len(theta))),
        planned=np.zeros((len(theta), len(theta))),
        prior=np.asarray(reader.value(objects["prior"]), float),
        ranges={n: Range(v["low"], v["mean"], v["high"]) for n, v in record["conditions"].items()},
        volume=np.array([[one["low"], one["high"]] for one in record["working_volume"]]),
        random=_effects_from(reader, objects["random"]),
        temperature_offset_K=float(record["temperature_offset_K"]),
        instrument_ports=tuple(record["instrument_ports"]),
        name=record["name"],
        date=record["date"],
        no_gain=record["no_gain"],
        about=record.get("about", {}),  # not in records of older versions
    )
    _check_sizes(bare)
    units = np.array([step / p.si for _, p, step in entries(bare)])
    covariance = _square(record["covariance"], units)
    planned = record["planned_covariance"]
    return replace(
        bare,
        covariance=covariance,
        planned=covariance if planned is None else _square(planned, units),
        rivals=tuple(_rival(reader, bare, one) for one in objects["rivals"]),
        check=_check_from(reader, bare, objects["check"]),
    )


def _check_sizes(machine: IdentifiedMachine) -> None:
    """Raise `NotStoredError` where parts of a record do not belong together."""
    axes, parameters = len(machine.axes), len(entries(machine))
    if machine.volume.shape != (axes, 2) or not np.isfinite(machine.volume).all():
        raise NotStoredError(f"a working volume that has no two ends for each of {axes} axes")
    if len(machine.theta) != parameters or len(machine.prior) != parameters:
        raise NotStoredError(
            f"{len(machine.theta)} values and {len(machine.prior)} prior variances of "
            f"{parameters} parameters"
        )
    if len(machine.shapes) != len(machine.effects):
        raise NotStoredError(f"shapes of {len(machine.shapes)} of {len(machine.effects)} effects")
    numbers = [one for r in machine.ranges.values() for one in (r.low, r.mean, r.high)]
    if not np.isfinite([*machine.theta, *numbers]).all():
        raise NotStoredError("a value or a condition that is no finite number")


def _value(machine: IdentifiedMachine, i: int, p: Parameter, step: float) -> float:
    """Value of an entry, in its unit."""
    if not p.shape:
        return p.mean + float(machine.theta[i]) * step / p.si
    shapes = [
        float(shape[q.name]) / q.si
        for effect, shape in zip(machine.effects, machine.shapes, strict=True)
        for q in effect.shapes
        if q.moves
    ]
    return shapes[i - (len(machine.theta) - len(machine.shape_steps))]


def _triangle(matrix: np.ndarray, units: np.ndarray) -> list[list[float]]:
    """Lower triangle, in the units of the parameters."""
    scaled = matrix * np.outer(units, units)
    return [[float(f"{v:.12g}") for v in row[: i + 1]] for i, row in enumerate(scaled.tolist())]


def _square(rows: Sequence[Sequence[float]], units: np.ndarray) -> np.ndarray:
    k = len(units)
    if [len(row) for row in rows] != list(range(1, k + 1)):
        raise NotStoredError("a covariance that is no triangle of as many rows as parameters")
    lower = np.zeros((k, k))
    for i, row in enumerate(rows):
        lower[i, : i + 1] = row
    full = lower + np.tril(lower, -1).T
    safe = np.where(units > 0.0, units, 1.0)
    return full / np.outer(safe, safe)


def _effects(writer: Writer, effects: Sequence[Effect]) -> list[Any]:
    found = []
    for effect, key in zip(effects, part_names(effects), strict=True):
        try:
            found.append({"key": key, "object": writer.plain(effect)})
        except NotStoredError as error:
            found.append({"key": key, "object": None, "because": str(error)})
    return found


def _effects_from(reader: Reader, given: Sequence[Mapping[str, Any]]) -> tuple[Effect, ...]:
    found = []
    for one in given:
        if one["object"] is None:
            raise NotStoredError(
                f"the effect {one['key']!r}, which is one of the user's own and cannot be restored "
                f"({one['because']})"
            )
        effect = reader.value(one["object"])
        if not isinstance(effect, Effect):
            raise NotStoredError(f"{one['key']!r}, which is no effect")
        found.append(effect)
    return tuple(found)


def _bare(writer: Writer, machine: IdentifiedMachine) -> dict[str, Any]:
    return {
        "effects": _effects(writer, machine.effects),
        "theta": writer.plain(machine.theta),
        "shapes": [writer.plain(dict(shape)) for shape in machine.shapes],
        "shape_steps": writer.plain(machine.shape_steps),
    }


def _bare_from(
    reader: Reader, machine: IdentifiedMachine, given: Mapping[str, Any]
) -> IdentifiedMachine:
    theta = np.asarray(reader.value(given["theta"]), float)
    k = len(theta)
    return replace(
        machine,
        effects=_effects_from(reader, given["effects"]),
        theta=theta,
        shapes=tuple(reader.value(shape) for shape in given["shapes"]),
        shape_steps=reader.value(given["shape_steps"]),
        covariance=np.zeros((k, k)),
        planned=np.zeros((k, k)),
        prior=np.full(k, math.inf),
    )


def _rival(reader: Reader, machine: IdentifiedMachine, given: Mapping[str, Any]) -> Rival:
    return Rival(
        _bare_from(reader, machine, given["found"]),
        tuple(
            (float(one["probability"]), _bare_from(reader, machine, one)) for one in given["others"]
        ),
        bool(given["averaged"]),
    )


def _check(writer: Writer, machine: IdentifiedMachine) -> Any:
    """Positions of the check points, with the conditions on which something depends."""
    plan = machine.check
    if plan is None:
        return None
    names = [n for n in plan.covariates if n in machine.ranges or n.startswith("dir_")]
    given = {n: np.asarray(plan.covariates[n], float) for n in names}
    return writer.plain({"position": np.asarray(plan.position, float), **given})


def _check_from(reader: Reader, machine: IdentifiedMachine, given: Any) -> Plan | None:
    if given is None:
        return None
    found = dict(reader.value(given))
    return Plan(machine.axes, found.pop("position"), found)
