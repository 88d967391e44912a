"""What a block of a program does: a move that is corrected, or a block that is left as it is."""

import math
from dataclasses import dataclass, field
from typing import NamedTuple

from .arcs import Arc
from .blocks import Block, Word

Point = list[float]
"""X, Y, Z in mm, axis positions."""


@dataclass(slots=True, eq=False)
class Cause:
    """Why moves were left as they are."""

    line: int
    text: str
    always: bool = False
    """Whether it is reported also where no move was counted, as a call of a subprogram."""
    moves: int = 0
    last: int = 0
    """Line of the last one."""


class Frame(NamedTuple):
    """How the coordinates of a block are read: axis position = scale x word + origin."""

    absolute: bool
    scale: float
    """mm per unit of the program."""
    origin: tuple[float, float, float]
    """Axis position of the program's zero, mm."""


class Piece(NamedTuple):
    """Part of a move in which every axis keeps its direction."""

    start: Point
    end: Point
    directions: tuple[float, float, float]
    length: float
    arc: Arc | None = None
    whole: bool = True
    """False where only the end is corrected: rapids, and moves from an unknown position."""
    tool_length: float = 0.0


@dataclass(slots=True)
class Move:
    """A block whose end is known on all axes, in terms of axis positions."""

    block: Block
    motion: int
    """0 to 3, as G0 to G3."""
    named: Word | None
    """Its own word of motion; None where the modal one is used."""
    axes: dict[int, Word]
    """Its words of X, Y and Z by the number of the axis."""
    frame: Frame
    pieces: list[Piece]
    plane: int
    centre_words: dict[str, Word]
    """I, J, K, R and P of an arc."""
    centre_absolute: bool
    inverse_time: float | None
    """The F of a block in inverse time (G93)."""
    feed_word: Word | None


@dataclass(slots=True)
class Left:
    """A block that is left as it is.

    `sets` holds what it does to the position: (axis, position or None), or with `by` the increment.
    """

    block: Block
    named: Word | None = None
    motion: int | None = None
    """The motion that it uses or sets, where it is one of G0 to G3."""
    sets: list[tuple[int, float | None]] = field(default_factory=list)
    by: bool = False
    back_to: list[tuple[int, float]] | None = None
    """Positions of the axes from which an arc that is left as it is has to begin."""
    frame: Frame | None = None


def line_piece(start: Point, end: Point, directions: list[float], tool_length: float) -> Piece:
    """A straight piece; `directions` are those of the axes before it, and are updated."""
    update(directions, [end[0] - start[0], end[1] - start[1], end[2] - start[2]])
    length = math.dist(start, end)
    return Piece(start, end, _frozen(directions), length, tool_length=tool_length)


def end_piece(
    start: list[float | None], end: Point, directions: list[float], tool_length: float
) -> Piece:
    """The end of a move that is not corrected on its way."""
    update(directions, [0.0 if a is None else b - a for a, b in zip(start, end, strict=True)])
    for i, a in enumerate(start):
        if a is None:
            directions[i] = 0.0
    return Piece(end, end, _frozen(directions), 0.0, None, False, tool_length)


def arc_pieces(
    arc: Arc, start: Point, end: Point, directions: list[float], tool_length: float, least: float
) -> list[Piece]:
    """The pieces of an arc between the reversals of its axes, and of at most a right angle."""
    shares = [0.0, *arc.reversals(least), 1.0]
    pieces, at = [], start
    for low, high in zip(shares[:-1], shares[1:], strict=True):
        part = arc.part(low, high)
        to = end if high == 1.0 else part.point(1.0)
        update(directions, part.directions())
        frozen = _frozen(directions)
        pieces.append(Piece(at, to, frozen, part.length(), part, tool_length=tool_length))
        at = to
    return pieces


STANDS_MM = 1e-7
"""An axis that moves less than this stands, and keeps its direction."""


def update(directions: list[float], move: Point) -> None:
    """The direction of every axis that moves; the last one stays where it stands."""
    for i in range(3):
        if move[i] > STANDS_MM:
            directions[i] = 1.0
        elif move[i] < -STANDS_MM:
            directions[i] = -1.0


def _frozen(directions: list[float]) -> tuple[float, float, float]:
    return directions[0], directions[1], directions[2]
