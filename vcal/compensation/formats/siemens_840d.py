"""SINUMERIK 840D: axis error compensation (ENC_COMP) and sag and angularity compensation (CEC).

ENC_COMP holds one table per axis, by its own position. Its values are taken from the actual
position: a positive value moves the axis in the negative direction. CEC tables have a base axis and
a compensation axis; the sum of the tables of an axis is an additional setpoint. A table with
``$AN_CEC_DIRECTION`` 1 or -1 holds in one direction of the base axis only, which carries backlash
as a function of the position. Both are linear between the points and constant beyond them.

With the option ``products``, pairs of tables that are multiplied (``$AN_CEC_MULT_BY_TABLE``) carry
angles times levers. In the example of the manual (sag of a foundation, X1 corrected by an angle
over X1 times Z1), a factor acts in the product only and not by itself; the text states the product
alone. Try a pair with small values before use.

Not found in the public pages, and left to the commissioning: the largest number of tables and
points of an 840D sl (``MD18342`` states those of a control; an 828D has 8 tables of 200 points).
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from jaxtyping import Float
from pydantic import Field as Key

from ..base import FORMATS, Covariates, Format, Options, Tables, at_inside
from ..fields import spaced
from ..headers import conditions_in_words, header
from ..lines import Line, Product, lines_of, products_of
from ..machine import IdentifiedMachine
from ..refusals import AXES, refuse_axes, refuse_travel

_MOST = 801
_STEP_M, _DIGITS = 1e-9, 6
_NODES = 21
"""Points per axis of factors."""
_LEAST_M = 1e-7
"""Products that stay below it are left out."""
_ITERATIONS = 3
_NAME = r"[A-Za-z_]\w*"


class SiemensOptions(Options):
    """Options of the compensation tables."""

    points: int = Key(
        default=101,
        ge=2,
        le=_MOST,
        description="points of every table (MD38000 and MD18342 must be at least as large)",
    )
    names: str = Key(
        default="X1,Y1,Z1",
        pattern=rf"^{_NAME},{_NAME},{_NAME}$",
        description="names of the machine axes X, Y and Z in the control, or AX1,AX2,AX3",
    )
    tables: int | None = Key(
        default=None,
        ge=1,
        description="CEC tables that the control has, such as 8 of an 828D; more are refused",
    )
    products: bool = Key(
        default=False,
        description="also products of two tables (MULT_BY_TABLE): angles times levers",
    )


@dataclass(frozen=True)
class SiemensTables(Tables):
    """The values as they stand in the files."""

    machine: IdentifiedMachine
    options: SiemensOptions
    at: Mapping[str, float]
    own: tuple[Line, ...]
    """ENC_COMP: corrections by the own position, alike in both directions."""
    cross: tuple[Line, ...]
    """CEC: corrections."""
    products: tuple[Product, ...]

    def applied(
        self,
        position: Float[np.ndarray, "n axes"],
        directions: Float[np.ndarray, "n axes"],
        covariates: Covariates,
    ) -> Float[np.ndarray, "n axes"]:
        del covariates
        column = {axis: i for i, axis in enumerate(self.machine.axes)}
        setpoint = np.array(position, float)
        for line in self.cross:
            by = column[line.by]
            setpoint[:, column[line.corrected]] += line.at(position[:, by], directions[:, by])
        for one in self.products:
            pair = (position[:, column[axis]] for axis in (one.first, one.second))
            setpoint[:, column[one.corrected]] += one.at(*pair)
        encoder = setpoint.copy()
        for line in self.own:
            i = column[line.by]
            for _ in range(_ITERATIONS):  # encoder + value(encoder) = setpoint
                encoder[:, i] = setpoint[:, i] + line.at(encoder[:, i], directions[:, i])
        return encoder - position

    @property
    def count(self) -> int:
        """CEC tables."""
        return sum(2 if line.directed else 1 for line in self.cross) + 2 * len(self.products)

    @cached_property
    def files(self) -> Mapping[str, str]:
        about = [
            *header(self.machine, Siemens840d),
            *conditions_in_words(self.machine, None, self.at),
        ]
        comments = [f"; {line}" for line in about]
        found = {"AX_EEC.INI": ["%_N_AX_EEC_INI", *comments, "CHANDATA(1)", *self._own(), "M17"]}
        if self.count:
            body = list(self._cross())
            found["NC_CEC.INI"] = ["%_N_NC_CEC_INI", *comments, "CHANDATA(1)", *body, "M17"]
        found["readme.txt"] = [*about, "", *self._readme()]
        return {name: "\n".join(lines) + "\n" for name, lines in found.items()}

    def _name(self, axis: str) -> str:
        return self.options.names.split(",")[AXES.index(axis)]

    def _own(self) -> Iterator[str]:
        for line in self.own:
            name = self._name(line.by)
            for n, value in enumerate(line.up):
                yield f"$AA_ENC_COMP[0,{n},{name}]={_mm(-value)}"
            yield f"$AA_ENC_COMP_STEP[0,{name}]={_step(line.nodes)}"
            yield f"$AA_ENC_COMP_MIN[0,{name}]={_mm(line.nodes[0])}"
            yield f"$AA_ENC_COMP_MAX[0,{name}]={_mm(line.nodes[-1])}"
            yield f"$AA_ENC_COMP_IS_MODULO[0,{name}]=0"

    def _cross(self) -> Iterator[str]:
        t = 0
        for line in self.cross:
            ways = [(1, line.up), (-1, line.down)] if line.directed else [(0, line.up)]
            for way, values in ways:
                yield from self._table(t, line.by, line.corrected, line.nodes, 1e3 * values, way, 0)
                t += 1
        for one in self.products:
            first, second = one.nodes
            yield from self._table(t, one.first, one.corrected, first, 1e3 * one.a, 0, t + 2)
            yield from self._table(t + 1, one.second, one.corrected, second, one.b, 0, 0)
            t += 2

    def _table(
        self,
        t: int,
        by: str,
        corrected: str,
        nodes: np.ndarray,
        values: np.ndarray,
        way: int,
        times: int,
    ) -> Iterator[str]:
        for n, value in enumerate(values):
            yield f"$AN_CEC[{t},{n}]={value + 0.0:.{_DIGITS}f}"
        yield f"$AN_CEC_INPUT_AXIS[{t}]=({self._name(by)})"
        yield f"$AN_CEC_OUTPUT_AXIS[{t}]=({self._name(corrected)})"
        yield f"$AN_CEC_STEP[{t}]={_step(nodes)}"
        yield f"$AN_CEC_MIN[{t}]={_mm(nodes[0])}"
        yield f"$AN_CEC_MAX[{t}]={_mm(nodes[-1])}"
        yield f"$AN_CEC_DIRECTION[{t}]={way}"
        yield f"$AN_CEC_MULT_BY_TABLE[{t}]={times}"
        yield f"$AN_CEC_IS_MODULO[{t}]=0"

    def _readme(self) -> Iterator[str]:
        points = self.options.points
        yield "Before loading: MD32700 ENC_COMP_ENABLE = 0 and MD32710 CEC_ENABLE = 0; tables are"
        yield "loaded only while both are off. A change of MD38000 or MD18342 formats the memory:"
        yield "save it first."
        for axis in AXES:
            if axis in self.machine.axes:
                name = self._name(axis)
                yield f"MD38000 MM_ENC_COMP_MAX_POINTS[0,{name}] >= {points}"
                yield f"MD32700 ENC_COMP_ENABLE[0,{name}] = 1, after loading AX_EEC.INI"
        sizes = [points] * (self.count - 2 * len(self.products))
        sizes += [_NODES] * (2 * len(self.products))
        for t, size in enumerate(sizes):
            yield f"MD18342 MM_CEC_MAX_POINTS[{t}] >= {size}, SD41300 CEC_TABLE_ENABLE[{t}] = 1"
        largest = {one.corrected: 0.0 for one in (*self.cross, *self.products)}
        for axis in largest:
            largest[axis] = sum(
                max(np.abs(line.up).max(), np.abs(line.down).max())
                for line in self.cross
                if line.corrected == axis
            ) + sum(np.abs(p.a).max() for p in self.products if p.corrected == axis)
        for axis, size in largest.items():
            name = self._name(axis)
            yield f"MD32710 CEC_ENABLE[{name}] = 1, after loading NC_CEC.INI"
            yield f"MD32720 CEC_MAX_SUM[{name}] >= {1e3 * size:.4f} mm"
        yield "MD32450 BACKLASH = 0: the tables contain it."
        yield "The signs of ENC_COMP and CEC are opposite: check one axis with an indicator."


@FORMATS.register
class Siemens840d(Format[SiemensOptions]):
    """Axis error and sag compensation of a SINUMERIK."""

    name = "siemens-840d"
    summary = "SINUMERIK 840D sl, 828D: axis error (ENC_COMP) and sag compensation (CEC)"
    source = (
        "Siemens, SINUMERIK 840D sl / 828D, Function Manual Extended Functions, 03/2013, "
        "6FC5397-1BP40-3BA1, K3 Compensations, pages 237 to 268; 808D, Function Manual, 01/2017, "
        "page 106 (sign of ENC_COMP)"
    )
    sign = (
        "ENC_COMP: the positioning error, subtracted from the position; CEC: added to the setpoint"
    )
    units = "mm"
    resolution = "1e-6 mm, linear between the points, constant beyond them"
    limits = (
        f"linear axes X, Y, Z; at most {_MOST} equidistant points per table; CEC tables: up to 12, "
        "with products 30 (option tables: those of the control)"
    )
    options = SiemensOptions

    def refuse(self, machine: IdentifiedMachine, options: SiemensOptions) -> str | None:
        unfit = refuse_axes(machine) or refuse_travel(machine)
        if unfit is not None:
            return unfit
        names = options.names.split(",")
        if len({*names}) < len(names):
            return (
                f"option names: found {options.names!r}, expected three different names of machine "
                "axes; correct it"
            )
        if options.tables is not None:
            needed = self.tables(machine, options).count
            if needed > options.tables:
                return (
                    f"option tables: the machine needs {needed} CEC tables, expected at most the "
                    f"{options.tables} of the control; leave products off, set MD18342 for more "
                    "tables, or choose another format"
                )
        return None

    def reason(self, machine: IdentifiedMachine, part: str) -> str:
        needs = next((p.needs for p in machine.parts if p.name == part), ())
        others = [n for n in needs if n not in machine.axes and not n.startswith("dir_")]
        if others:
            return f"depends on {', '.join(others)}, for which the table has one value"
        return "a table depends on the position of one axis; see option products"

    def tables(self, machine: IdentifiedMachine, options: SiemensOptions) -> SiemensTables:
        at = at_inside(machine, options)
        nodes = _nodes(machine, options.points)
        lines = [line.rounded(_STEP_M) for line in lines_of(machine, nodes, at)]
        own, cross = [], []
        for line in lines:
            if line.corrected == line.by:
                middle = np.round((line.up + line.down) / (2.0 * _STEP_M)) * _STEP_M
                own.append(replace(line, up=middle, down=middle))
                line = replace(line, up=line.up - middle, down=line.down - middle)
                line = line.rounded(_STEP_M)
            if line.used:
                cross.append(line)
        products = ()
        if options.products:
            products = tuple(
                replace(one, a=_rounded(one.a, _STEP_M), b=_rounded(one.b, 10.0**-_DIGITS))
                for one in products_of(machine, _nodes(machine, _NODES), at, _LEAST_M)
            )
        return SiemensTables(machine, options, at, tuple(own), tuple(cross), products)


def _nodes(machine: IdentifiedMachine, points: int) -> dict[str, np.ndarray]:
    """Equidistant points over the travels, with ends in whole multiples of the resolution."""
    ends = _rounded(machine.volume, _STEP_M)
    pairs = zip(machine.axes, ends, strict=True)
    return {axis: spaced(low, high, points) for axis, (low, high) in pairs}


def _rounded(values: np.ndarray, step: float) -> np.ndarray:
    return np.round(values / step) * step


def _mm(value_m: float) -> str:
    return f"{1e3 * value_m + 0.0:.{_DIGITS}f}"


def _step(nodes: np.ndarray) -> str:
    """Distance of the points, mm, with all digits: (MAX - MIN) / STEP is a whole number."""
    return f"{1e3 * (nodes[-1] - nodes[0]) / (len(nodes) - 1):.12g}"
