"""A machine for its dynamics, from a TOML description."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from pydantic import ValidationError

from ..dynamics.bodies import BED, GROUND, Body, Drive, Friction, Machine, Scale, Spring, ToolPoint
from ..dynamics.closed_loop import check_stable, controlled
from ..dynamics.control import Controller
from ..dynamics.gains import propose
from ..dynamics.modal_analysis import check_supported, modes
from ..dynamics.setpoints import Limits
from ..dynamics.structure import Structure, assemble
from ..errors import StudyError
from ..machine.chain import Chain, chain_from_string
from ..registry import nearest
from .machine_description import (
    BodySettings,
    ControllerSettings,
    DriveSettings,
    MachineDescription,
    SpringSettings,
    ToolPointSettings,
)
from .messages import explain, listed, refusal, shown
from .toml_file import read_setup

_EXACT = 1e-6
_MOTOR_KG = 1e-3
"""Least mass of a motor."""
_ROUNDED = 0.01
"""Relative excess of a moment of inertia over the sum of the others that rounding may cause."""
_HELD = 1e-3
"""Share of the largest stiffness from which springs are considered to hold an axis."""


class Described(NamedTuple):
    """A machine with its controllers and limits."""

    machine: Machine
    controller: Controller
    limits: Limits


def load_machine(path: Path | str, overrides: Sequence[str] = ()) -> Described:
    """Read and check the description of a machine's dynamics, and set up its controllers.

    Raises `StudyError` for every mistake in the file, for a body that no spring or drive holds, for
    an axis that cannot travel or moves nothing, and for an unstable control loop.
    """
    path = Path(path)
    raw, given = read_setup(path, overrides)
    try:
        found = MachineDescription.model_validate_json(json.dumps(raw, default=str), strict=True)
    except ValidationError as error:
        raise explain(error, path.name, raw, MachineDescription, given) from error
    machine = _machine(found, path.name)
    structure = assemble(machine)
    try:
        check_supported(structure, [body.name for body in machine.bodies])
    except ValueError as error:
        raise StudyError(f"{path.name}, {error}") from error
    _check_travel(machine, structure, path.name)
    machine = _damped(machine, structure, found)
    structure = assemble(machine)
    controller = _controller(found.controller, structure, path.name)
    try:
        check_stable(controlled(structure, controller), structure)
    except ValueError as error:
        raise StudyError(f"{path.name}, {error}") from error
    limits = Limits(
        found.limits.velocity_m_per_min / 60.0,
        found.limits.acceleration_m_per_s2,
        found.limits.jerk_m_per_s3,
    )
    return Described(machine, controller, limits)


def _machine(found: MachineDescription, file: str) -> Machine:
    chain = _chain(found.chain, file)
    _check_names([body.name for body in found.body], "body", "name", file)
    _check_names([drive.axis for drive in found.drive], "drive", "axis", file)
    bodies = _bodies(found.body, chain, file)
    links = {body.name: body.link for body in bodies}
    springs = _springs(found.spring, links, chain, file)
    drives, scales = _drives(found.drive, links, chain, file)
    tool_point = _tool_point(found.tool_point, links, chain, file)
    friction = _friction(found, drives, file)
    return Machine(chain, bodies, springs, drives, scales, tool_point, 0.0, friction)


def _chain(text: str, file: str) -> Chain:
    try:
        return chain_from_string(text)
    except ValueError as error:
        found, _, expected = str(error).rpartition("expected ")
        raise refusal(
            file,
            "key chain",
            f"an impossible {found.rstrip(';: ')}",
            expected.partition(" (")[0],  # only studies have other joints
            "correct the chain",
        ) from error


def _bodies(settings: Sequence[BodySettings], chain: Chain, file: str) -> tuple[Body, ...]:
    known, made = (BED, *chain.axes), []
    for i, body in enumerate(settings):
        if body.on is None and body.name not in known:
            raise refusal(
                file,
                f"key body.{i}.name",
                f"{body.name!r}{nearest(body.name, known)} without the key on",
                f"one of the names {listed(known)}, or the key on with the one that carries it",
                "correct the name, or add the key",
            )
        link = body.on or body.name
        _known(link, known, f"body.{i}.on", file)
        _check_inertia(body, f"body.{i}.inertia_kg_m2", file)
        inertia = jnp.diag(jnp.array(body.inertia_kg_m2))
        made.append(Body(body.name, link, body.mass_kg, inertia, 1e-3 * jnp.array(body.centre_mm)))
    return tuple(made)


def _springs(
    settings: Sequence[SpringSettings], links: Mapping[str, str], chain: Chain, file: str
) -> tuple[Spring, ...]:
    """One spring per point; `links` maps the name of a body to its link."""
    made = []
    for i, spring in enumerate(settings):
        for name in spring.between:
            _known(name, (*links, GROUND), f"spring.{i}.between", file)
        if spring.between[0] == spring.between[1]:
            raise refusal(
                file,
                f"key spring.{i}.between",
                f"{spring.between[0]!r} twice",
                "two bodies, or a body and 'ground'",
                "correct one of the names",
            )
        first = spring.between[0] if spring.between[0] != GROUND else spring.between[1]
        link = spring.on or links[first]
        _known(link, (BED, *chain.axes), f"spring.{i}.on", file)
        made += [
            Spring(
                spring.name,
                *spring.between,
                link,
                1e-3 * jnp.array(point),
                1e6 * jnp.array(spring.stiffness_N_per_um),
                1e3 * jnp.array(spring.turning_Nm_per_mrad),
                1e3 * jnp.array(spring.damping_Ns_per_mm),
            )
            for point in spring.points_mm
        ]
    return tuple(made)


def _drives(
    settings: Sequence[DriveSettings], links: Mapping[str, str], chain: Chain, file: str
) -> tuple[tuple[Drive, ...], tuple[Scale, ...]]:
    """The drives with their scales; `links` maps the name of a body to its link."""
    drives, scales = [], []
    for i, drive in enumerate(settings):
        _known(drive.axis, chain.axes, f"drive.{i}.axis", file)
        if drive.axis not in links:
            raise refusal(
                file,
                f"key drive.{i}.axis",
                f"{drive.axis!r}, which is no name of a body",
                f"the name of the body that the drive moves, one of {listed(links)}",
                "correct the axis, or rename the body",
            )
        base = drive.base or _towards_bed(chain, drive.axis, links, GROUND)
        _known(base, (*links, GROUND), f"drive.{i}.base", file)
        _check_screw(drive, f"drive.{i}", file)
        screw = None if drive.screw_N_per_um is None else 1e6 * drive.screw_N_per_um
        place = (drive.axis, drive.axis, base, drive.axis)
        drives.append(Drive(*place, 1e-3 * jnp.array(drive.point_mm), screw, drive.motor_mass_kg))
        at = drive.scale_mm or drive.point_mm
        scales.append(Scale(*place, 1e-3 * jnp.array(at), drive.measured == "motor"))
    return tuple(drives), tuple(scales)


def _check_screw(drive: DriveSettings, key: str, file: str) -> None:
    """Raise `StudyError` for a motor encoder without a screw, and for a screw without inertia."""
    if drive.screw_N_per_um is None:
        if drive.measured == "motor":
            raise refusal(
                file,
                f"key {key}.measured",
                "'motor' on a drive without a screw",
                "'scale', as a linear motor has no encoder of its own",
                "correct the key, or add screw_N_per_um",
            )
    elif drive.motor_mass_kg < _MOTOR_KG:
        left_out = drive.motor_mass_kg == 0.0
        raise refusal(
            file,
            f"key {key}.motor_mass_kg",
            f"{'none' if left_out else f'{drive.motor_mass_kg:g}'} for a drive with a screw",
            "the inertia of motor and screw as a mass, J (2 pi / pitch)^2"
            + ("" if left_out else f", of at least {_MOTOR_KG:g}"),
            "add it" if left_out else "correct the value",
        )


def _tool_point(
    end: ToolPointSettings, links: Mapping[str, str], chain: Chain, file: str
) -> ToolPoint:
    tool = end.tool or _last(chain, "tool", links)
    work = end.work or _last(chain, "workpiece", links)
    _known(tool, links, "tool_point.tool", file)
    _known(work, (*links, GROUND), "tool_point.work", file)
    return ToolPoint(tool, work, links[tool], 1e-3 * jnp.array(end.point_mm))


def _check_inertia(body: BodySettings, key: str, file: str) -> None:
    """Raise `StudyError` for moments of inertia that no body has: I_x <= I_y + I_z is violated."""
    largest, whole = max(body.inertia_kg_m2), sum(body.inertia_kg_m2)
    if largest > (1.0 + _ROUNDED) * (whole - largest):
        raise refusal(
            file,
            f"key {key}",
            shown(body.inertia_kg_m2),
            "no moment above the sum of the two others, as for any body",
            "correct them",
        )


def _check_travel(machine: Machine, structure: Structure, file: str) -> None:
    """Raise `StudyError` where springs hold an axis, or where a scale or the tool point does not
    follow it.
    """
    travel, stiffness = np.asarray(structure.travel), np.asarray(structure.stiffness)
    holding = np.einsum("na,nm,ma->a", travel, stiffness, travel)
    most = float(np.diag(stiffness).max())
    tool, scale = np.asarray(structure.tool) @ travel, np.asarray(structure.scale) @ travel
    for i, axis in enumerate(structure.axes):
        if holding[i] > _HELD * most:
            raise refusal(
                file,
                "table spring",
                f"springs that hold axis {axis} along its travel, with {1e-6 * holding[i]:.4g} "
                "N/um",
                "springs that leave it free, as only its drive holds it",
                f"set their stiffness along {axis} to 0",
            )
        own = np.eye(len(structure.axes))[i]
        for found, expected, what, keys in (
            (scale[:, i], own, "scales that read", "drive.*.base"),
            (
                tool[:, i],
                np.asarray(machine.chain.joint(axis).direction),
                "a tool point that moves against the workpiece by",
                "tool_point.tool and tool_point.work",
            ),
        ):
            if np.abs(found - expected).max() > _EXACT:
                raise refusal(
                    file,
                    f"keys {keys}",
                    f"{what} {np.round(found, 6).tolist()} per travel of {axis}",
                    f"{expected.tolist()}",
                    "correct the bodies that they belong to",
                )


def _friction(
    found: MachineDescription, drives: Sequence[Drive], file: str
) -> tuple[Friction, ...]:
    by_axis = {drive.axis: drive for drive in drives}
    _check_names([friction.axis for friction in found.friction], "friction", "axis", file)
    made = []
    for i, one in enumerate(found.friction):
        _known(one.axis, by_axis, f"friction.{i}.axis", file)
        stiction = one.coulomb_N if one.stiction_N is None else one.stiction_N
        if stiction < one.coulomb_N:
            raise refusal(
                file,
                f"key friction.{i}.stiction_N",
                f"{stiction:g}",
                f"at least coulomb_N = {one.coulomb_N:g}",
                "correct one of them",
            )
        drive = by_axis[one.axis]
        made.append(
            Friction(
                axis=one.axis,
                link=drive.link,
                point=drive.point if one.point_mm is None else 1e-3 * jnp.array(one.point_mm),
                coulomb=one.coulomb_N,
                stiction=stiction,
                stribeck=1e-3 * one.stribeck_mm_per_s,
                presliding=1e-6 * one.presliding_um,
                viscous=1e3 * one.viscous_Ns_per_mm,
            )
        )
    return tuple(made)


def _damped(machine: Machine, structure: Structure, found: MachineDescription) -> Machine:
    hz = found.damping_hz or float(modes(structure).hz[0])
    loss = found.damping / (np.pi * hz)  # D = loss K has the ratio loss omega / 2
    return replace(machine, loss=loss)


def _controller(found: ControllerSettings, structure: Structure, file: str) -> Controller:
    count = len(structure.axes)
    given: dict[str, Any] = {}
    for key, factor, name in (
        ("position_gain_per_s", 1.0, "position_gain"),
        ("bandwidth_rad_per_s", 1.0, "bandwidth"),
        ("integral_time_ms", 1e-3, "integral_time"),
    ):
        value = getattr(found, key)
        if isinstance(value, tuple) and len(value) != count:
            raise refusal(
                file,
                f"key controller.{key}",
                f"{len(value)} values",
                f"one, or one for each of {listed(structure.axes)}",
                "correct the list",
            )
        if value is not None:
            given[name] = factor * np.broadcast_to(np.asarray(value, float), (count,))
    if found.delay_ms >= 2.0 * found.sample_time_ms:
        raise refusal(
            file,
            "key controller.delay_ms",
            f"{found.delay_ms:g}",
            f"less than two sample times, {2.0 * found.sample_time_ms:g}",
            "correct it, or the sample time",
        )
    try:
        return propose(
            structure,
            **given,
            feed_forward=found.feed_forward,
            delay=1e-3 * found.delay_ms,
            sample_time=1e-3 * found.sample_time_ms,
        )
    except ValueError as error:
        raise StudyError(f"{file}, {error}") from error


def _check_names(names: Sequence[str], table: str, key: str, file: str) -> None:
    for i, name in enumerate(names):
        if name in names[:i] or name == GROUND:
            raise refusal(
                file,
                f"key {table}.{i}.{key}",
                f"{name!r} {'again' if name in names[:i] else ', which is not a body'}",
                "every name once",
                "rename or remove one of them",
            )


def _known(name: str, known: Any, key: str, file: str) -> None:
    if name not in known:
        raise refusal(
            file,
            f"key {key}",
            f"{name!r}{nearest(name, known)}",
            f"one of {listed(known)}",
            "correct the name",
        )


def _side(chain: Chain, side: str) -> list[str]:
    order = chain.tool_side if side == "tool" else chain.workpiece_side
    return [chain.joints[i].name for i in order]


def _towards_bed(chain: Chain, axis: str, bodies: Any, otherwise: str) -> str:
    side = _side(chain, chain.joint(axis).side)
    for name in reversed([BED, *side[: side.index(axis)]]):
        if name in bodies:
            return name
    return otherwise


def _last(chain: Chain, side: str, bodies: Any) -> str:
    for name in reversed([BED, *_side(chain, side)]):
        if name in bodies:
            return name
    return GROUND
