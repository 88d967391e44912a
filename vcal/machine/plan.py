"""Commanded positions and recorded conditions: one row per observation."""

from collections.abc import Collection, Iterable, Mapping, Sequence
from typing import Self

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int

from ..numerics.arrays import Array, array, arrays, known, namespace
from ..numerics.record import Record

DATA_SET = "data_set"
"""Name of the group that holds the index in `Plan.sets` of the data set of every row."""


def of_set(name: str, what: str) -> str:
    """Name of a quantity of one data set in a joint plan: ``"tracker:azimuth"``."""
    return f"{name}:{what}"


class Axes(tuple[str, ...]):
    """Names of the axes of a machine, which know which joints of an arm slide: the names of these
    (``"J1"``) do not show it, as those of the axes of machine tools do (X, C).

    It equals a tuple of the same names.
    """

    sliding: frozenset[str]
    """Names of the prismatic joints of an arm."""

    def __new__(cls, names: Iterable[str] = (), sliding: Iterable[str] = ()) -> Self:
        """From the names of all axes and of the prismatic joints among them."""
        made = super().__new__(cls, names)
        made.sliding = frozenset(sliding)
        return made

    def __getnewargs__(self) -> tuple[tuple[str, ...], frozenset[str]]:
        return tuple(self), self.sliding

    def __eq__(self, other: object) -> bool:
        same = not isinstance(other, Axes) or self.sliding == other.sliding
        return same and tuple.__eq__(self, other) is True  # type: ignore[arg-type]

    def __ne__(self, other: object) -> bool:
        return not self == other

    def __hash__(self) -> int:
        return tuple.__hash__(self)


def slides(axes: Sequence[str], axis: str) -> bool:
    """Whether an axis is a prismatic joint of an arm, with positions in metres."""
    return isinstance(axes, Axes) and axis in axes.sliding


class Plan(Record):
    """Positions and conditions of all observations of a run, in the order of time.

    A plan is a pytree of arrays with a leading row axis (n). A covariate that was not recorded is
    absent; an effect that needs it cannot be tested, and is reported as not tested.
    """

    axes: tuple[str, ...] = eqx.field(static=True)
    """Names of the joints, in the order of the columns of `position`."""
    position: Float[Array, "n axes"] = eqx.field(converter=array)
    """Axis positions, m or rad: commanded ones, or those that were probed (ball array) or read back
    (arm)."""
    covariates: Mapping[str, Float[Array, " n"]] = eqx.field(converter=arrays, default_factory=dict)
    """Other recorded quantities, SI, by name: ``"dir_X"`` (+1, -1), ``"t"`` (s), ``"T_X"``,
    ``"T_air"`` (degC), ``"commanded_J1"``, ``"read_J1"`` (rad), ..."""
    groups: Mapping[str, Int[Array, " n"]] = eqx.field(converter=arrays, default_factory=dict)
    """Group indices by name: ``"pose"``, ``"ball"``, ``"run"``, ``"segment"``."""
    sets: tuple[str, ...] = eqx.field(static=True, default=())
    """Names of the data sets, whose rows follow one after the other; empty for a single data set.

    Quantities that all data sets share have their plain name. Quantities that only some of them
    have, or that concern the instrument of one only, are named by `of_set`; they are nan in the
    rows of the other data sets (group indices: -1).
    """
    numbers: Int[Array, " n"] | None = None
    """Number of every row in its table, from 1, if rows of the table are left out; else None."""

    def __check_init__(self) -> None:
        if not known(self.position):
            return
        if self.position.ndim != 2 or self.position.shape[1] != len(self.axes):
            raise ValueError(
                f"plan: found positions of shape {self.position.shape}, expected (rows, "
                f"{len(self.axes)}), one column for each of the axes {', '.join(self.axes)}; "
                "correct the positions or the axes"
            )
        finite = np.isfinite(np.asarray(self.position))
        if not finite.all():
            row, column = np.argwhere(~finite)[0]
            raise ValueError(
                f"plan: found the position {self.position[row, column]} of {self.axes[column]} in "
                f"row {row}, expected a finite number; correct it, or leave the row out"
            )
        own = {} if self.numbers is None else {"numbers": self.numbers}
        tables = ("covariate", self.covariates), ("group", self.groups), ("column", own)
        for what, table in tables:
            for name, values in table.items():
                if known(values) and values.shape != (self.rows,):
                    raise ValueError(
                        f"plan: found the {what} {name!r} of shape {values.shape}, expected "
                        f"({self.rows},), one value for each of the {self.rows} positions; give "
                        "as many"
                    )

    @property
    def rows(self) -> int:
        """Number of observations."""
        return self.position.shape[0]

    def x(self, axis: str) -> Float[Array, " n"]:
        """Position of one axis (n,), m or rad."""
        return self.position[:, self.axes.index(axis)]

    def covariate(self, name: str) -> Float[Array, " n"]:
        """A covariate by name (n,), SI. Raises `KeyError` where it was not recorded."""
        return self.covariates[name]

    def values(self, name: str) -> Float[np.ndarray, " n"]:
        """Values of an axis, covariate or group index (n,), nan in rows of data sets without it.

        With a name of `of_set`, shared quantities are given in the rows of that data set only.
        Raises `KeyError` where the quantity was not recorded.
        """
        key = self._key(name)
        if key in self.axes:
            found = np.asarray(self.x(key), float)
        elif key in self.covariates:
            found = np.asarray(self.covariates[key], float)
        else:
            found = np.asarray(self.groups[key], float)
        owner = name.partition(":")[0]
        return np.where(self.in_set(owner), found, np.nan) if owner in self.sets else found

    def has(self, *names: str) -> bool:
        """Whether all of these covariates, groups or axes were recorded: in all rows or, with a
        name of `of_set`, in those of one data set.
        """
        known = {*self.covariates, *self.groups, *self.axes}
        return all(self._key(name) in known for name in names)

    def _key(self, name: str) -> str:
        """The name of the column that holds the quantity `name` of one data set."""
        owner, _, plain = name.partition(":")
        if owner in self.sets and name not in self.covariates and name not in self.groups:
            return plain
        return name

    def with_position(self, position: Float[Array, "n axes"]) -> "Plan":
        """The same plan at other axis positions."""
        return Plan(self.axes, position, self.covariates, self.groups, self.sets, self.numbers)

    def elsewhere(self, position: Float[Array, "m axes"], rows: Int[Array, " m"]) -> "Plan":
        """Other positions (m, axes), each under the conditions of one of the `rows` (m,); groups
        are dropped.

        Commanded and read positions move with the position: their difference from it is a
        condition, their value is not.
        """
        found = {name: np.asarray(values)[rows] for name, values in self.covariates.items()}
        moved = position - np.asarray(self.position)[rows]
        for i, axis in enumerate(self.axes):
            for name in {f"commanded_{axis}", f"read_{axis}"} & set(found):
                found[name] = found[name] + moved[:, i]
        return Plan(self.axes, position, found)

    def take(self, rows) -> "Plan":
        """The given rows only.

        In numpy where rows and columns are known: jax would compile a program for every number of
        rows.
        """
        plain = known(rows) or isinstance(rows, slice | list)

        def pick(table):
            return {
                k: (np.asarray(v) if plain and known(v) else jnp.asarray(v))[rows]
                for k, v in table.items()
            }

        return Plan(
            self.axes,
            self.position[rows],
            pick(self.covariates),
            pick(self.groups),
            self.sets,
            None if self.numbers is None else self.numbers[rows],
        )

    # --- several data sets ----------------------------------------------------------------------
    def in_set(self, name: str) -> Bool[np.ndarray, " n"]:
        """Which rows belong to one data set (n,)."""
        return np.asarray(self.groups[DATA_SET]) == self.sets.index(name)

    @property
    def parts(self) -> dict[str, Bool[np.ndarray, " n"]]:
        """Rows of every data set (n,) by its name; a single data set has the empty name."""
        if not self.sets:
            return {"": np.ones(self.rows, bool)}
        return {name: self.in_set(name) for name in self.sets}

    def in_time(self, rows: Int[np.ndarray, " m"]) -> Int[np.ndarray, " m"]:
        """These rows (m,), data set by data set, in the order of time however the file is sorted;
        in the order of the file where time was not recorded.
        """
        ordered = []
        for name, inside in self.parts.items():
            mine, time = rows[inside[rows]], of_set(name, "t") if name else "t"
            if self.has(time):
                mine = mine[np.argsort(self.values(time)[mine], kind="stable")]
            ordered.append(mine)
        return np.concatenate(ordered)

    def place(self, row: int) -> tuple[str, int]:
        """The data set of a row and the row's number in its table, from 0; the name is empty for a
        single data set. Raises `IndexError` for a row that does not exist.
        """
        for name, inside in self.parts.items():
            if inside[row]:
                if self.numbers is not None:
                    return name, int(self.numbers[row]) - 1
                return name, int(inside[:row].sum())
        raise IndexError(f"found row {row}, expected one of {self.rows}")

    def row_name(self, row: int) -> str:
        """Number of a row in its table, from 1, with its data set if there are several."""
        name, number = self.place(row)
        return f"{number + 1} of {name}" if name else str(number + 1)

    def of(self, name: str) -> "Plan":
        """All rows, with the names that one data set uses.

        In the rows of other data sets, its own covariates are zero and its group indices -1.
        Quantities that only other data sets have are left out.
        """
        here = self.groups[DATA_SET] == self.sets.index(name)
        prefix, tables = of_set(name, ""), []
        owned = (DATA_SET, *(of_set(s, "") for s in self.sets))
        for table, none in ((self.covariates, 0), (self.groups, -1)):
            own = {k: v for k, v in table.items() if not k.startswith(owned)}
            for key, values in table.items():
                if key.startswith(prefix):
                    found = namespace(here, values).where(here, values, none)
                    own[key.removeprefix(prefix)] = found
            tables.append(own)
        return Plan(self.axes, self.position, *tables, numbers=self.numbers)

    def part(self, name: str) -> "Plan":
        """The rows of one data set, as if there were no others."""
        return self.of(name).take(np.flatnonzero(self.in_set(name)))

    def lacking(self, name: str) -> tuple[str, ...]:
        """Names of the data sets without this covariate, group or axis."""
        return tuple(s for s in self.sets if not self.has(of_set(s, name)))


def joined(plans: Mapping[str, Plan], own: Mapping[str, Collection[str]]) -> Plan:
    """One plan of the rows of several data sets, one after the other.

    `plans` are the plans by the name of the data set. `own` lists, per data set, the covariates
    that concern only its own instrument. Group indices always do, as they count within one table.
    Raises `ValueError` where there are no plans, or where their axes differ.
    """
    if not plans:
        raise ValueError("found no data set, expected at least one")
    axes = {plan.axes for plan in plans.values()}
    if len(axes) > 1:
        raise ValueError(f"data sets of machines with the axes {axes}, expected the same axes")
    names = tuple(plans)
    shared = set.intersection(
        *({*plan.covariates} - {*own.get(name, ())} for name, plan in plans.items())
    )
    sizes = [plan.rows for plan in plans.values()]
    ends = np.cumsum(sizes)
    first = next(iter(plans.values()))
    covariates = {
        key: np.concatenate([np.asarray(plan.covariates[key], float) for plan in plans.values()])
        for key in first.covariates
        if key in shared
    }
    groups = {DATA_SET: np.repeat(np.arange(len(names)), sizes)}
    for (name, plan), size, end in zip(plans.items(), sizes, ends, strict=True):
        for key, values in plan.covariates.items():
            if key not in shared:
                column = covariates[of_set(name, key)] = np.full(ends[-1], np.nan)
                column[end - size : end] = values
        for key, values in plan.groups.items():
            column = groups[of_set(name, key)] = np.full(ends[-1], -1)
            column[end - size : end] = values
    position = np.concatenate([np.asarray(plan.position) for plan in plans.values()])
    numbers = None
    if any(plan.numbers is not None for plan in plans.values()):
        numbers = np.concatenate([_numbers(plan) for plan in plans.values()])
    return Plan(first.axes, position, covariates, groups, names, numbers)


def _numbers(plan: Plan) -> Int[np.ndarray, " n"]:
    """Number of every row in its table, from 1."""
    return np.arange(1, plan.rows + 1) if plan.numbers is None else np.asarray(plan.numbers)
