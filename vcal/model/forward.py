"""A machine, an instrument and everything that disturbs them, as one function.

`predict` follows one observation: command, pose, observation, reading, reduction. All effects act
through the ports (`vcal.machine.ports`). The derivative of the readings with respect to the ports
is compiled once per chain and instrument; the derivative by every parameter follows from it.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import accumulate, pairwise
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from ..effects.base import Effect, Setup
from ..instruments.base import Instrument
from ..machine.chain import Chain
from ..machine.parameters import Parameter
from ..machine.plan import Plan
from ..machine.ports import PortLayout
from ..numerics.arrays import Array, array, known
from ..numerics.compiled import filter_jit_outermost
from ..numerics.record import Record
from ..numerics.rigid import Rotation, Scalar, Vector, exp, left_jacobian_matrix
from ..numerics.spatial import require_float64, rotation, skew

Shapes = Mapping[int, Mapping[str, Any]]
"""Values of shape parameters (SI) by position of the effect in the model."""


class Terms(NamedTuple):
    """Effects as data: the ports are `offset`, plus ``values * theta[parameter]`` at `port` for
    every term.

    This is exact for amplitudes; shape parameters are linearised at their present values.
    """

    offset: Float[Array, "n p"]
    values: Float[Array, "n terms"]
    """Response per solver unit of the parameter, SI unit of the port."""
    port: Int[Array, " terms"]
    parameter: Int[Array, " terms"]


@dataclass(frozen=True)
class Entry:
    """One parameter in the model's parameter vector."""

    effect: int
    """Position of its effect in `Model.effects`."""
    parameter: Parameter
    key: str
    """Identifier of the effect with placement."""


class Model(Record):
    """A kinematic chain, an instrument and effects."""

    chain: Chain
    instrument: Instrument
    effects: tuple[Effect, ...]
    """Effects that are fitted: systematic effects and nuisances."""
    random: tuple[Effect, ...]
    """Effects with an independent draw per row: they contribute to the covariance of the readings.
    """

    def __init__(self, chain: Chain, instrument: Instrument, effects: Iterable[Effect] = ()):
        given = tuple(effects)
        self.chain = chain
        self.instrument = instrument
        self.effects = tuple(e for e in given if e.kind != "random")
        self.random = tuple(e for e in given if e.kind == "random")

    @property
    def layout(self) -> PortLayout:
        """Names and positions of the ports of one observation."""
        return PortLayout.of(self.chain.axes, self.instrument.ports)

    def setup(self, plan: Plan) -> Setup:
        """The information from which effects decide where they may occur."""

        def of(instrument: Instrument, layout: PortLayout, plan: Plan, **more: Any) -> Setup:
            own: dict[str, Any] = {"artefact": instrument.artefact, "derived": instrument.derived}
            own["stations"] = instrument.stations
            return Setup(self.chain, layout, plan, self.effects, **own, **more)

        members = self.instrument.members
        parts = [
            of(m, PortLayout.of(self.chain.axes, m.ports), plan.part(name), data_set=name)
            for name, m in members.items()
        ]
        return of(self.instrument, self.layout, plan, parts=tuple(parts))

    def with_effects(self, *effects: Effect) -> "Model":
        """The same model with further effects: the only change that closing the loop makes."""
        return Model(self.chain, self.instrument, (*self.effects, *self.random, *effects))

    def without(self, effect: int) -> "Model":
        """The same model without the effect at that position."""
        kept = tuple(e for i, e in enumerate(self.effects) if i != effect)
        return Model(self.chain, self.instrument, (*kept, *self.random))

    def check_plan(self, plan: Plan) -> None:
        """Raise `ValueError` for a plan with other axes, or with the axes in another order."""
        if plan.axes != self.chain.axes:
            raise ValueError(
                f"plan: found the axes {', '.join(plan.axes)}, expected "
                f"{', '.join(self.chain.axes)} in this order, as in the chain; reorder the columns "
                "of the positions"
            )

    @cached_property
    def entries(self) -> tuple[Entry, ...]:
        """The amplitudes of all effects, in the order of the parameter vector."""
        return tuple(Entry(i, p, e.key) for i, e in enumerate(self.effects) for p in e.amplitudes)

    @cached_property
    def places(self) -> tuple[slice, ...]:
        """Positions in the parameter vector of the amplitudes of every effect."""
        ends = [0, *accumulate(len(e.amplitudes) for e in self.effects)]
        return tuple(slice(*pair) for pair in pairwise(ends))

    def shapes_at(self, plan: Plan, shapes: Shapes | None = None) -> dict[int, dict[str, Any]]:
        """Values (SI) of all shape parameters by position of the effect: the given value, else the
        declared value, else the middle of the scan on `plan`.
        """
        found: dict[int, dict[str, Any]] = {}
        for i, effect in enumerate(self.effects):
            if not effect.shapes:
                continue
            declared = {name for name, *_ in effect.given}
            known = {p.name: p.mean * p.si for p in effect.shapes if p.name in declared}
            known |= (shapes or {}).get(i, {})
            grids = {} if all(p.name in known for p in effect.shapes) else effect.scan(plan)
            found[i] = {
                p.name: known[p.name]
                if p.name in known
                else float(grids[p.name][len(grids[p.name]) // 2])
                for p in effect.shapes
            }
        return found

    def terms(self, plan: Plan, shapes: Shapes | None = None) -> Terms:
        """Responses of all effects per solver unit (prior sigma) of their amplitudes.

        Shape parameters (SI) are completed by `shapes_at`.
        """
        shapes, layout = self.shapes_at(plan, shapes), self.layout
        blocks = [
            effect_terms(effect, layout, plan, shapes.get(i, {}), place.start)
            for i, (effect, place) in enumerate(zip(self.effects, self.places, strict=True))
        ]
        return concatenate(blocks, plan.rows, len(self.layout))


def effect_terms(
    effect: Effect, layout: PortLayout, plan: Plan, shape: Mapping[str, Any], start: int = 0
) -> Terms:
    """Terms of one effect, whose first amplitude is at `start` in the parameter vector.

    `shape` are its shape parameters (SI). Raises `ValueError` where the response names a port or an
    amplitude that does not exist.
    """
    amplitudes = {p.name: (k, p) for k, p in enumerate(effect.amplitudes)}
    offset = np.zeros((plan.rows, len(layout)))
    values, ports, parameters = [], [], []
    for (port, amplitude), column in effect.response(plan, shape).items():
        if amplitude not in amplitudes:
            raise ValueError(
                f"effect {effect.key!r}: its response names amplitude {amplitude!r}, "
                f"but its amplitudes are {', '.join(amplitudes)}"
            )
        k, parameter = amplitudes[amplitude]
        column = np.broadcast_to(np.asarray(column, float), (plan.rows,))
        place = layout.index(port)
        if parameter.mean:
            offset[:, place] += column * parameter.mean * parameter.si
        values.append(column * parameter.step)
        ports.append(place)
        parameters.append(start + k)
    stacked = np.stack(values, 1) if values else np.zeros((plan.rows, 0))
    return Terms(offset, stacked, np.asarray(ports, int), np.asarray(parameters, int))  # type: ignore


def concatenate(blocks: Sequence[Terms], rows: int, ports: int) -> Terms:
    """Terms of several effects as one."""
    empty = Terms(np.zeros((rows, ports)), np.zeros((rows, 0)), *[np.zeros(0, int)] * 2)  # type: ignore
    offsets, *parts = zip(empty, *blocks, strict=True)
    return Terms(sum(offsets), *(np.concatenate(part, -1) for part in parts))  # type: ignore


def observe_row(
    chain: Chain, instrument: Instrument, q: Sequence[Scalar], row: Any, ports: Sequence[Scalar]
) -> tuple[Scalar, ...]:
    """Reading of one observation (SI) from its axis positions `q` (m or rad) and its ports."""
    joints = 6 * len(chain.joints)
    r, t = chain.pose(q, _twists(chain, ports))
    tool = ports[joints : joints + 6]
    t = t + r @ (Vector.of(chain.tool_offset) + Vector.of(tool[:3]))
    r = r @ exp(Vector.of(tool[3:]))
    return tuple(instrument.observe(row, r, t, split_ports(instrument, ports[joints + 6 :])))


def _twists(chain: Chain, ports: Sequence[Scalar]) -> list[Sequence[Scalar]]:
    return [ports[6 * i : 6 * i + 6] for i in range(len(chain.joints))]


def split_ports(instrument: Instrument, ports: Sequence[Scalar]) -> dict[str, Sequence[Scalar]]:
    """The part of the port vector that belongs to the instrument, by group name."""
    bounds: dict[str, list[int]] = {}
    for i, name in enumerate(instrument.ports):
        bounds.setdefault(name.split(".")[0], [i, i])[1] = i + 1
    return {name: ports[a:b] for name, (a, b) in bounds.items()}


def port_values(terms: Terms, theta: Float[Array, " k"], size: int) -> Float[Array, "n p"]:
    """Port vector of every row (n, p), SI: the sum of the terms."""
    columns = terms.values * theta[terms.parameter]
    if known(terms.port):
        return terms.offset + columns @ np.eye(size)[np.asarray(terms.port)]
    return terms.offset + columns @ jax.nn.one_hot(terms.port, size, dtype=columns.dtype)


@eqx.filter_jit
def observe_all(
    chain: Chain, instrument: Instrument, position: Array, rows: Any, ports: Array
) -> Float[Array, "n m"]:
    """`observe_row` over all rows."""
    found = observe_columns(chain, instrument, position, rows, list(jnp.asarray(ports).T))
    return jnp.stack(found, -1)


def observe_columns(
    chain: Chain, instrument: Instrument, position: Array, rows: Any, ports: Sequence[Scalar]
) -> tuple[Float[Array, " n"], ...]:
    """`observe_row` over all rows, with one array per port and per component of the reading.

    A port that is a plain number is a constant, equal in every row; a port without axes is a
    variable, equal in every row.
    """
    return _over_rows(
        lambda q, row, p: observe_row(chain, instrument, q, row, p), position, rows, ports
    )


@eqx.filter_jit
def observe_with_jacobian(
    chain: Chain, instrument: Instrument, position: Array, rows: Any, ports: Array
) -> tuple[Float[Array, "n m"], Float[Array, "n m p"]]:
    """`observe_row` over all rows, and its derivative with respect to the ports of each row."""
    size = 6 * len(chain.joints) + 6

    def one(q, row, p):
        r, t, moved, turned = _tool_with_jacobian(chain, q, p)

        def reading(r, t, own):
            own = split_ports(instrument, list(own))
            return jnp.stack(instrument.observe(row, Rotation.of(r), Vector.of(t), own))

        def push(along):
            down = along[:3], skew(along[3:6]) @ r, along[6:]
            return jax.jvp(lambda t, r, own: reading(r, t, own), (t, r, p[size:]), down)

        # Value and derivative from one trace of the instrument: half the compilation.
        directions = jnp.eye(6 + p.shape[0] - size)
        value, slopes = jax.vmap(push, out_axes=(None, -1))(directions)
        by_tool = slopes[:, :3] @ moved + slopes[:, 3:6] @ turned
        return value, jnp.concatenate([by_tool, slopes[:, 6:]], 1)

    return jax.vmap(one)(position, rows, ports)


@filter_jit_outermost
def compared_with_jacobian(
    chain: Chain, instrument: Instrument, plan: Plan, rows: Any, measured: Array, ports: Array
) -> tuple[Float[Array, "n m"], Float[Array, "n m p"]]:
    """Difference of the readings `measured` (n, m) from those predicted with these ports, and the
    derivative of the predicted readings by the ports, SI.

    It is compiled once for an instrument and a plan, whatever the model.
    """
    predicted, by_port = observe_with_jacobian(chain, instrument, plan.position, rows, ports)
    difference = instrument.difference(measured, instrument.reduce(predicted, plan))
    return difference, instrument.reduce(by_port, plan)


def _tool_with_jacobian(chain: Chain, q: Array, ports: Array) -> tuple[Array, Array, Array, Array]:
    """Tool frame and tool point in the workpiece frame, and their derivatives by the ports of the
    chain and of the tool: displacement of the point and rotation of the frame (3, 6 axes + 6).
    """
    joints = 6 * len(chain.joints)
    tool = ports[joints : joints + 6]
    r, t, moved, turned = chain.jacobian(
        q, ports[:joints].reshape(-1, 6), chain.tool_offset + tool[:3]
    )
    still, spin = jnp.zeros((3, 3)), r @ left_jacobian_matrix(tool[3:])
    return (
        r @ rotation(tool[3:]),
        t,
        jnp.concatenate([moved, r, still], 1),
        jnp.concatenate([turned, still, spin], 1),
    )


def tool_point(chain: Chain, q: Sequence[Scalar], ports: Sequence[Scalar]) -> Vector:
    """Tool point in the workpiece frame (m) for one row, from the ports of chain and tool."""
    joints = 6 * len(chain.joints)
    r, t = chain.pose(q, _twists(chain, ports))
    offset = Vector.of(chain.tool_offset) + Vector.of(ports[joints : joints + 3])
    return t + r @ offset


@eqx.filter_jit
def tool_points(chain: Chain, position: Array, ports: Array) -> Float[Array, "n 3"]:
    """`tool_point` over all rows."""
    return jnp.stack(tool_columns(chain, position, list(jnp.asarray(ports).T)), -1)


@eqx.filter_jit
def tool_points_with_jacobian(
    chain: Chain, position: Array, ports: Array
) -> tuple[Float[Array, "n 3"], Float[Array, "n 3 p"]]:
    """`tool_point` over all rows, and its derivative with respect to the ports of each row."""

    def one(q, p):
        _, t, moved, _ = _tool_with_jacobian(chain, q, p)
        return t, jnp.pad(moved, ((0, 0), (0, p.shape[0] - moved.shape[1])))

    return jax.vmap(one)(position, ports)


def tool_columns(
    chain: Chain, position: Array, ports: Sequence[Scalar]
) -> tuple[Float[Array, " n"], ...]:
    """`tool_point` over all rows, with one array per port and per coordinate.

    A port that is a plain number is a constant, equal in every row.
    """
    return _over_rows(lambda q, _, p: tool_point(chain, q, p).parts, position, (), ports)


def _over_rows(
    function, position: Array, rows: Any, ports: Sequence[Scalar]
) -> tuple[Float[Array, " n"], ...]:
    """`function(q, row, ports)` of one row over all rows; `ports` is a sequence of single ports."""
    varies = [not isinstance(p, float) and jnp.ndim(p) == 1 for p in ports]
    varying = [p for p, own in zip(ports, varies, strict=True) if own]

    def one(q, row, values):
        left = iter(values)
        here = [next(left) if own else p for p, own in zip(ports, varies, strict=True)]
        return tuple(jnp.asarray(v) for v in function(list(q), row, here))

    return jax.vmap(one)(position, rows, varying)


def check_theta(model: Model, theta: Any) -> None:
    """Raise `ValueError` unless `theta` has one value per amplitude, optionally followed by one per
    shape parameter that moves, as in a fit.

    Compiled code would otherwise read past the end of the array without an error.
    """
    amplitudes = len(model.entries)
    moving = sum(p.moves for effect in model.effects for p in effect.shapes)
    if np.shape(theta) not in ((amplitudes,), (amplitudes + moving,)):
        more = f", or ({amplitudes + moving},) with the shape parameters" if moving else ""
        raise ValueError(
            f"theta: found shape {np.shape(theta)}, expected ({amplitudes},), one value per "
            f"amplitude of the model{more}; `Model.entries` lists them in order"
        )


def check_keep(plan: Plan, keep: Any) -> None:
    """Raise `ValueError` unless `keep` has one value per row; a single one would apply to all."""
    if np.shape(keep) != (plan.rows,):
        raise ValueError(
            f"keep: found shape {np.shape(keep)}, expected ({plan.rows},), True or False for each "
            "row of the plan; give as many"
        )


def predict(
    model: Model, plan: Plan, theta: Float[Array, " k"], shapes: Shapes | None = None
) -> Float[Array, "n m"]:
    """Reduced readings (n, m) of a plan, SI.

    `theta` (k,) are the amplitudes in solver units (`Model.entries`), `shapes` the values of shape
    parameters in SI, completed by `Model.shapes_at`. Only `theta` may be traced, by `jax.jit`,
    `jax.vmap` and other transformations.

    Raises `RuntimeError` where JAX runs in float32, and `ValueError` where plan or theta do not fit
    the model.
    """
    require_float64()
    model.check_plan(plan)
    check_theta(model, theta)
    with jax.ensure_compile_time_eval():  # the effects are plain data even where theta is traced
        terms = model.terms(plan, shapes)
    # In numpy where it is not traced: the first call of an operation of jax takes a compilation.
    theta = np.asarray(theta) if known(theta) else array(theta)
    ports = port_values(terms, theta, len(model.layout))
    readings = observe_all(
        model.chain, model.instrument, plan.position, model.instrument.rows(plan), ports
    )
    return model.instrument.reduce(readings, plan)
