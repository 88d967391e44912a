"""Sums over the rows of a plan, of candidates at many steps of their grids at once.

With the derivatives g of the whitened readings by the ports, a candidate whose amplitudes displace
the ports by phi has the columns C = g phi. The score test needs C'r, C'J, C'C and C'r*. A port's
projections g'r, g'J and g'r* serve all candidates on it.
"""

import abc
import itertools
from collections.abc import Callable, Iterator, Sequence
from typing import NamedTuple

import numpy as np
from scipy.sparse import csr_matrix

from ...effects.forms import Tones
from ...numerics.equal_frequencies import EqualFrequencies

_ROOM = 2**27
"""Most bytes of projections on ports that are kept, and of sums that are made together. The
projections of a larger plan are made for a block of rows at a time, and all candidates are summed
over it before the next, so that the memory does not grow with rows, ports, steps and null residuals
together."""
_BLOCK_ROWS = 256, 4_096
"""Fewest and most rows of such a block."""
_FEW = 512
"""Most groups of alike rows."""
_CACHED = 2**16
"""Numbers that stay in the cache."""

Moved = list[tuple[int, tuple[int, ...], np.ndarray]]
"""(port, amplitudes that act on it (a), displacement in solver units (g, a, n)) of every port."""
Moving = Callable[[slice], Moved]
"""What a candidate moves in some rows."""
Candidates = Sequence[tuple[int, Moving]]
"""Candidates with the same number of amplitudes: the number of steps of each, and what it moves."""


class Sums(NamedTuple):
    """The sums of a candidate with c amplitudes at g steps."""

    residual: np.ndarray
    """C'r (g, c)."""
    jacobian: np.ndarray
    """C'J (g, c, k)."""
    squares: np.ndarray
    """C'C (g, c, c)."""
    null: np.ndarray
    """C'r* (g, c, draws)."""
    most: np.ndarray
    """What C'C would be if every displacement moved the readings as much as the port that moves
    them most (g, c)."""

    @classmethod
    def zeros(cls, g: int, c: int, k: int, draws: int) -> "Sums":
        """Sums over no rows."""
        null = np.zeros((g, c, draws), np.float32)
        return cls(
            np.zeros((g, c)), np.zeros((g, c, k)), np.zeros((g, c, c)), null, np.zeros((g, c))
        )

    def replace(self, at: np.ndarray, by: "Sums") -> None:
        """Put other sums in place of those at the steps `at`."""
        for whole, part in zip(self, by, strict=True):
            whole[at] = part


class Projected(NamedTuple):
    """Projections of some rows on one port."""

    residual: np.ndarray
    """(rows)."""
    null: np.ndarray
    """(rows, draws), in single precision."""
    jacobian: np.ndarray
    """(rows, k)."""


class Rows(abc.ABC):
    """The rows of a plan, or groups of rows, over which candidates are summed."""

    reach: float
    """Squared derivative of the readings of a row by the port that moves them most."""
    weights: np.ndarray
    """Number of rows that each stands for (n)."""
    parameters: int
    draws: int

    @abc.abstractmethod
    def blocks(self) -> list[slice]:
        """The rows in the blocks in which they are summed."""

    @abc.abstractmethod
    def projected(self, rows: slice, ports: Sequence[int]) -> list[Projected]:
        """The projections of the rows of a block on these ports."""

    @abc.abstractmethod
    def both(self, p: int, q: int) -> np.ndarray:
        """Inner product (n) of the whitened responses of the readings to two ports."""

    def sums(self, c: int, candidates: Candidates, null: bool = True) -> Sums:
        """Sums of candidates with `c` amplitudes."""
        return self.sums_of([(c, candidates)], null)[0]

    def sums_of(self, some: Sequence[tuple[int, Candidates]], null: bool = True) -> list[Sums]:
        """Sums of several groups of candidates, each with its number of amplitudes."""
        firsts = [np.cumsum([0, *(size for size, _ in candidates)]) for _, candidates in some]
        draws = self.draws if null else 0
        found = [
            Sums.zeros(first[-1], c, self.parameters, draws)
            for first, (c, _) in zip(firsts, some, strict=True)
        ]
        for rows in self.blocks():
            for sums, first, (_, candidates) in zip(found, firsts, some, strict=True):
                moved = [moving(rows) for _, moving in candidates]
                self._add(sums, rows, list(zip(first[:-1], first[1:], moved, strict=True)))
        return found

    def together(self, some: Sequence[tuple[int, Candidates]]) -> Iterator[slice]:
        """The groups in parts whose sums have room together."""
        first, taken = 0, 0
        for i, (c, candidates) in enumerate(some):
            one = sum(size for size, _ in candidates) * c * (4 * self.draws + 8 * self.parameters)
            if i > first and taken + one > _ROOM:
                yield slice(first, i)
                first, taken = i, 0
            taken += one
        if len(some) > first:
            yield slice(first, len(some))

    def _add(self, sums: Sums, rows: slice, of: Sequence[tuple[int, int, Moved]]) -> None:
        """Add the sums over one block of rows; of steps from the first number up to the second."""
        k, draws = sums.jacobian.shape[2], sums.null.shape[2]
        through: dict[tuple[int, tuple[int, ...]], list[tuple[np.ndarray, np.ndarray]]] = {}
        for begin, end, moved in of:
            steps = np.arange(begin, end)
            for port, a, phi in moved:
                through.setdefault((port, a), []).append((steps, phi))
            for (p, a, fa), (q, b, fb) in itertools.combinations_with_replacement(moved, 2):
                both = _inner(fa, fb, self.both(p, q)[rows])
                at = steps[:, None, None]
                sums.squares[at, np.array(a)[:, None], np.array(b)] += both
                if p != q:
                    sums.squares[at, np.array(b)[:, None], np.array(a)] += both.transpose(0, 2, 1)
        # All responses through the same port are one matrix product, whichever effect they belong
        # to.
        ports = list(dict.fromkeys(port for port, _ in through))
        on = dict(zip(ports, self.projected(rows, ports), strict=True))
        for (port, a), parts in through.items():
            at = np.concatenate([steps for steps, _ in parts])[:, None], np.array(a)
            phi = np.concatenate([phi for _, phi in parts]) if len(parts) > 1 else parts[0][1]
            squares = np.einsum("gaa->ga", _inner(phi, phi, self.weights[rows]))
            sums.most[at] += self.reach * squares
            (r, drawn, j), shape, flat = on[port], phi.shape[:2], phi.reshape(-1, phi.shape[2])
            sums.residual[at] += (flat @ r).reshape(shape)
            sums.jacobian[at] += (flat @ j).reshape(*shape, k)
            if draws:
                sums.null[at] += (flat.astype(np.float32) @ drawn).reshape(*shape, draws)


def _inner(a: np.ndarray, b: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Sums (g, a, b) over the rows of a (g, a, n) times b (g, b, n) times weights; of as many steps
    at a time as stay in the cache of the processor.
    """
    few = max(1, _CACHED // max(a[0].size, 1)) if len(a) else 1
    parts = [slice(i, i + few) for i in range(0, len(a), few)]
    found = [(a[part] * weights) @ b[part].transpose(0, 2, 1) for part in parts]
    return np.concatenate(found) if found else np.zeros((0, a.shape[1], b.shape[1]))


class EveryRow(Rows):
    """All rows (n), each with m readings.

    `ports` (n, m, p): whitened derivatives by the ports; `residual` (n, m), `null` (n, m, draws)
    and `jacobian` (n, m, k): what is projected on them.
    """

    def __init__(
        self, ports: np.ndarray, residual: np.ndarray, null: np.ndarray, jacobian: np.ndarray
    ):
        self.ports, self.residual, self.null, self.jacobian = ports, residual, null, jacobian
        self.reach = float((ports**2).sum(1).max(initial=0.0))
        self.parameters, self.draws = jacobian.shape[2], null.shape[2]
        self.weights = np.ones(len(ports))
        most = _ROOM // max(ports.shape[2] * (8 + 4 * self.draws + 8 * self.parameters), 1)
        whole = len(ports) <= most
        self._size = len(ports) if whole else int(np.clip(most, *_BLOCK_ROWS))
        self._kept: dict[int, Projected] = {}
        """Projections of the rows `_at`, by port."""
        self._at = slice(0, 0)
        self._products: dict[tuple[int, int], np.ndarray] = {}
        self._alike: dict[bytes, tuple[np.ndarray, AlikeRows]] = {}

    def blocks(self) -> list[slice]:
        n = len(self.ports)
        return [slice(i, min(i + self._size, n)) for i in range(0, n, max(self._size, 1))]

    def projected(self, rows: slice, ports: Sequence[int]) -> list[Projected]:
        if rows != self._at:
            self._kept, self._at = {}, rows
        if new := [port for port in ports if port not in self._kept]:
            self._kept.update(zip(new, self._projected(rows, new), strict=True))
        return [self._kept[port] for port in ports]

    def release(self) -> None:
        """Forget the projections of a block, which are of no use once all is summed over it."""
        if self._size < len(self.ports):
            self._kept, self._at = {}, slice(0, 0)

    def _projected(self, rows: slice, ports: Sequence[int]) -> list[Projected]:
        g = np.ascontiguousarray(self.ports[rows][:, :, ports].transpose(0, 2, 1))
        r = np.einsum("npm,nm->pn", g, self.residual[rows])
        drawn = (g.astype(np.float32) @ self.null[rows]).transpose(1, 0, 2)
        j = (g @ self.jacobian[rows]).transpose(1, 0, 2)
        return [Projected(*one) for one in zip(r, drawn, j, strict=True)]

    def both(self, p: int, q: int) -> np.ndarray:
        if (p, q) not in self._products:
            self._products[p, q] = np.einsum("nm,nm->n", self.ports[:, :, p], self.ports[:, :, q])
        return self._products[p, q]

    def alike(self, columns: Sequence[np.ndarray]) -> "tuple[np.ndarray, AlikeRows] | None":
        """Groups of rows that are equal in all columns (n), with one row (groups) of each; None
        where there are too many groups to save time.
        """
        if not columns:
            return None
        labels = np.zeros(len(self.ports), int)
        for column in columns:
            one = np.unique(column, return_inverse=True)[1]
            labels = np.unique(labels * (one.max() + 1) + one, return_inverse=True)[1]
        if labels.max() >= min(_FEW, len(labels) // 4):
            return None
        key = labels.tobytes()
        if key not in self._alike:
            members = np.unique(labels, return_index=True)[1]
            self._alike[key] = members, AlikeRows(self, labels)
        return self._alike[key]

    def tone_sums(self, port: int, tones: Tones, sizes: Sequence[float]) -> Sums:
        """Sums of the sines and the cosines on one port at all frequencies of a scan, in units
        `sizes` of their two amplitudes.
        """
        n = len(self.ports)
        x, first, step, count = tones
        waves = EqualFrequencies(x, first, step, count)
        quick = EqualFrequencies(x, first, step, count, single=True)
        twice = EqualFrequencies(x, 2.0 * first, 2.0 * step, count)
        grid = np.zeros((waves.size, 1 + self.parameters))
        drawn_grid = np.zeros((quick.size, self.draws), np.float32)
        for rows in self.blocks():
            ((r, drawn, j),) = self.projected(rows, [port])
            grid += waves.spread(rows, np.column_stack([r, j]))
            drawn_grid += quick.spread(rows, drawn)
        both = np.column_stack([self.both(port, port), np.ones(n)])
        double = twice.sums(twice.spread(slice(0, n), both))
        real, imaginary = np.real(double), np.imag(double)
        size = np.array(sizes)

        def parts(sums: np.ndarray) -> np.ndarray:
            """Of the sines and the cosines (count, 2, c)."""
            return np.stack([np.imag(sums), np.real(sums)], axis=1) * size[:, None]

        found = parts(waves.sums(grid))
        null = parts(quick.sums(drawn_grid)).astype(np.float32)
        # sin^2 = (1 - cos 2) / 2, cos^2 = (1 + cos 2) / 2, sin cos = (sin 2) / 2.
        half = 0.5 * np.stack([-real, real], axis=1)
        squares = (half + 0.5 * both.sum(0)) * size[:, None] ** 2
        cc = np.empty((count, 2, 2))
        cc[:, [0, 1], [0, 1]] = squares[:, :, 0]
        cc[:, [0, 1], [1, 0]] = 0.5 * size.prod() * imaginary[:, :1]
        return Sums(found[:, :, 0], found[:, :, 1:], cc, null, self.reach * squares[:, :, 1])


class AlikeRows(Rows):
    """Groups of rows in which a candidate moves the ports alike, `labels` (n): 0, 1, ... .

    The sum over the rows of phi'x, with phi the same in a group, is that over the groups of phi and
    the group's sum of x.
    """

    def __init__(self, every: EveryRow, labels: np.ndarray):
        self._every, self._labels = every, labels
        self.reach, self.parameters, self.draws = every.reach, every.parameters, every.draws
        self.weights = np.bincount(labels).astype(float)
        self._sums: dict[int, Projected] = {}
        self._products: dict[tuple[int, int], np.ndarray] = {}

    def blocks(self) -> list[slice]:
        return [slice(0, len(self.weights))]

    def projected(self, rows: slice, ports: Sequence[int]) -> list[Projected]:
        del rows
        return [self._of(port) for port in ports]

    def _of(self, port: int) -> Projected:
        if port not in self._sums:
            groups, every = len(self.weights), self._every
            sums = np.zeros((groups, 1 + every.parameters))
            null = np.zeros((groups, every.draws), np.float32)
            for rows in every.blocks():
                ((r, drawn, j),) = every.projected(rows, [port])
                labels = self._labels[rows]
                entries = np.ones(len(labels), np.float32), labels, np.arange(len(labels) + 1)
                gathered = csr_matrix(entries, shape=(len(labels), groups)).T
                sums += gathered.astype(float) @ np.column_stack([r, j])
                null += gathered @ drawn
            self._sums[port] = Projected(sums[:, 0], null, sums[:, 1:])
        return self._sums[port]

    def both(self, p: int, q: int) -> np.ndarray:
        if (p, q) not in self._products:
            self._products[p, q] = np.bincount(self._labels, self._every.both(p, q))
        return self._products[p, q]
