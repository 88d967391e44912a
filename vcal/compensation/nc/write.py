"""Corrected blocks as text. Words that change are replaced in place; the rest stays as it is."""

import math
import operator
from decimal import Decimal
from typing import NamedTuple

from . import codes
from .arcs import AXES, centre_through
from .blocks import Block, Word
from .moves import Frame, Left, Move
from .options import NcOptions
from .split import JUMP_SHARE, Span

_LETTERS = "XYZ"
_CENTRE = {17: "IJ", 18: "KI", 19: "JK"}
_PATH = "IJKRP"


class Target(NamedTuple):
    """One block to be written: its end (3,), mm, and the middle of its arc."""

    end: list[float]
    middle: list[float] | None
    """None for a straight line."""
    weight: float
    """Length, mm, by which the time of the block is shared."""


class Grid:
    """Numbers at the output resolution."""

    def __init__(self, resolution: float):
        self.resolution = resolution
        exponent = Decimal(repr(resolution)).normalize().as_tuple().exponent
        self.format = f"%.{max(-int(exponent), 1)}f"

    def text(self, value: float) -> str:
        """The nearest number, with a decimal point: ``"10.0"``, ``"-0.0312"``."""
        resolution = self.resolution
        text = (self.format % (round(value / resolution) * resolution)).rstrip("0")
        return text + "0" if text[-1] == "." else text


class Writer:
    """Writes blocks in order, and follows where the written program has driven the axes."""

    def __init__(self, options: NcOptions):
        self.options = options
        self.at = [math.nan] * 3
        """Axis positions, mm, to which the written program has moved."""
        self.motion: int | None = None
        """Of the written program."""
        self.grids = {False: Grid(options.resolution_mm), True: Grid(options.resolution_inch)}
        self.separator, self.eol = " ", "\n"
        self.corrected = self.split = 0
        self.displaced: dict[int, list[int]] = {}
        """Lines of split blocks by their M codes whose time of action is not known."""

    # --- blocks left as they are ------------------------------------------------------------------

    def left(self, left: Left) -> str:
        """Text of a block that is left as it is."""
        block = left.block
        self._style(block)
        before, text = "", block.text
        moves = bool(left.sets)
        if left.back_to and left.frame:
            before = self._return(left, left.back_to, left.frame)
        if moves and left.named is None and left.motion is not None and self.motion != left.motion:
            text = self._with_motion(block, left.motion)
        if left.motion is not None and (moves or left.named):
            self.motion = left.motion
        for axis, value in left.sets:
            if value is None:
                self.at[axis] = math.nan
            else:
                self.at[axis] = self.at[axis] + value if left.by else value
        return f"{before}{text}{block.eol}"

    def _return(self, left: Left, back_to: list[tuple[int, float]], frame: Frame) -> str:
        """A straight block to the programmed start of an arc, whose end is not corrected either."""
        grid = self._grid(frame)
        half = 0.5 * grid.resolution * frame.scale
        off = [(i, p) for i, p in back_to if not abs(self.at[i] - p) <= half]
        off = [(i, p) for i, p in off if not math.isnan(self.at[i])]
        if not off:
            return ""
        words = ["G1"]
        for i, p in off:
            text = grid.text((p - frame.origin[i]) / frame.scale)
            words.append(_LETTERS[i] + text)
            self.at[i] = float(text) * frame.scale + frame.origin[i]
        block = left.block
        words += [block.text[w.start : w.end] for w in block.words if w.letter == "F"]
        self.motion = 1
        return self._line(block, words) + (block.eol or self.eol)

    # --- corrected moves --------------------------------------------------------------------------

    def move(self, move: Move, spans: list[list[Span]], largest: float) -> str:
        """Text of a corrected move: one block or several."""
        self._style(move.block)
        step = self._grid(move.frame).resolution * move.frame.scale
        if largest < 0.5 * step and self._as_programmed(move, 0.5 * step):
            return self._unchanged(move)
        targets = self._targets(move, spans, step)
        self.corrected += 1
        self.split += len(targets) > 1
        last = len(targets) - 1
        total = sum(t.weight for t in targets) if last else 0.0
        texts: list[str] = []
        for k, target in enumerate(targets):
            feed = self._feed(move, target, total) if last else None
            if k == 0:
                texts.append(self._first(move, target, feed, bool(last)))
            else:
                stops = self._stops(move.block) if k == last else []
                words = self._further(move, target, feed)
                if words or stops:
                    texts.append(self._line(move.block, words + stops))
        eol = move.block.eol or self.eol
        return eol.join(texts) + move.block.eol

    def _as_programmed(self, move: Move, half: float) -> bool:
        """Whether the block as it is drives the programmed way, within half a step."""
        frame, first, end = move.frame, move.pieces[0], move.pieces[-1].end
        reached = list(self.at)
        for i, word in move.axes.items():
            reached[i] = self._programmed(frame, i, word)
        pairs = list(zip(reached, end, strict=True))
        if first.whole:
            pairs += zip(self.at, first.start, strict=True)
        return all(abs(a - b) < half for a, b in pairs)

    def _programmed(self, frame: Frame, axis: int, word: Word) -> float:
        """Where the word as it is drives an axis."""
        zero = frame.origin[axis] if frame.absolute else self.at[axis]
        return zero + frame.scale * float(word.value or 0.0)

    def _unchanged(self, move: Move) -> str:
        frame = move.frame
        for i, word in move.axes.items():
            self.at[i] = self._programmed(frame, i, word)
        text = move.block.text
        if move.named is None and self.motion != move.motion:
            text = self._with_motion(move.block, move.motion)
        self.motion = move.motion
        return text + move.block.eol

    def _targets(self, move: Move, spans: list[list[Span]], step: float) -> list[Target]:
        """Ends of blocks. Where the correction jumps because an axis turns round, a straight block
        of its own takes it up.
        """
        least = max(1e-3 * self.options.tolerance_um * JUMP_SHARE, step)
        targets: list[Target] = []
        at = self.at
        for piece, parts in zip(move.pieces, spans, strict=True):
            jump = math.dist(parts[0].start, at) if piece.whole else 0.0
            if jump > least:
                targets.append(Target(parts[0].start, None, jump))
            for part in parts:
                middle = None if part.straight else part.middle
                targets.append(Target(part.end, middle, part.share * piece.length))
            at = parts[-1].end
        return targets

    def _feed(self, move: Move, target: Target, total: float) -> str | None:
        """The inverse time of a part: 1 / F is shared by length."""
        if move.inverse_time is None or target.weight <= 0.0:
            return None
        value = move.inverse_time * total / target.weight
        digits = max(3, 6 - len(str(int(value))))
        return f"F{value:.{digits}f}"

    def _first(self, move: Move, target: Target, feed: str | None, split: bool) -> str:
        """The programmed block, with the words that change replaced."""
        block = move.block
        edit = _Edit(block, self.separator)
        start = list(self.at)
        coordinates = self._coordinates(move, target)
        if self._too_flat(move, target, start):
            target = target._replace(middle=None)
        code = self._code(move, target)
        if move.named is None:
            if self.motion != code:
                edit.before_axes(f"G{code}")
        elif code != move.motion:
            edit.replace(move.named, f"G{code}")
        for i, text in enumerate(coordinates):
            word = move.axes.get(i)
            if text is None:
                continue
            if word is not None:
                edit.replace(word, block.text[word.start] + text)
            else:
                edit.after_axes(_LETTERS[i] + text)
        if target.middle is None:
            for word in move.centre_words.values():
                edit.remove(word)
        elif move.centre_words:
            self._edit_centre(edit, move, target, start, split)
        if feed is not None and move.feed_word is not None:
            edit.replace(move.feed_word, feed)
        if split:
            for word in self._stop_words(block):
                edit.remove(word)
            self._note_codes(block)
        self.motion = code
        return edit.text()

    def _edit_centre(
        self, edit: "_Edit", move: Move, target: Target, start: list[float], split: bool
    ) -> None:
        grid = self._grid(move.frame)
        new = self._centre(move, target, start)
        for letter, word in move.centre_words.items():
            if letter not in new:
                if split:
                    edit.remove(word)
            elif split or abs(new[letter] - float(word.value or 0.0)) >= 0.5 * grid.resolution:
                edit.replace(word, edit.block.text[word.start] + grid.text(new[letter]))
        for letter, value in new.items():
            if letter not in move.centre_words and (text := grid.text(value)) not in _ZEROS:
                edit.last(letter + text)

    def _further(self, move: Move, target: Target, feed: str | None) -> list[str]:
        """Words of a further block; none where it would move nothing."""
        start = list(self.at)
        coordinates = self._coordinates(move, target, further=True)
        if self._too_flat(move, target, start):
            target, self.at = target._replace(middle=None), list(start)
            coordinates = self._coordinates(move, target, further=True)
        words = [_LETTERS[i] + text for i, text in enumerate(coordinates) if text is not None]
        if not words:
            return []
        code = self._code(move, target)
        if code != self.motion:
            words.insert(0, f"G{code}")
        if target.middle is not None:
            grid = self._grid(move.frame)
            centre = self._centre(move, target, start)
            words += [letter + grid.text(value) for letter, value in centre.items()]
        self.motion = code
        return [*words, feed] if feed is not None else words

    def _too_flat(self, move: Move, target: Target, start: list[float]) -> bool:
        """Whether an arc between the written ends is a straight line within half a step.

        Rounding of the ends can bend a short arc to the other side; the circle through its middle
        would then be driven the long way round.
        """
        if target.middle is None:
            return False
        u, v, _ = AXES[move.plane]
        x, y = self.at[u] - start[u], self.at[v] - start[v]
        chord = math.hypot(x, y)
        across = x * (target.middle[v] - start[v]) - y * (target.middle[u] - start[u])
        sagitta = across if move.motion == 2 else -across  # G3 has its middle right of the chord
        half = 0.5 * self._grid(move.frame).resolution * move.frame.scale
        return not sagitta > half * chord

    def _code(self, move: Move, target: Target) -> int:
        return min(move.motion, 1) if target.middle is None else move.motion

    def _coordinates(self, move: Move, target: Target, further: bool = False) -> list[str | None]:
        """Numbers (3,) of a block to the target; None where no word has to be written.

        The position that is kept is that of the written numbers, so that roundings of increments do
        not add up.
        """
        frame, grid = move.frame, self._grid(move.frame)
        half = 0.5 * grid.resolution
        arc = target.middle is not None
        found: list[str | None] = []
        for i in range(3):
            zero = frame.origin[i] if frame.absolute else self.at[i]
            value = (target.end[i] - zero) / frame.scale
            word = None if further else move.axes.get(i)
            if word is not None:
                same = word.value or 0.0
                changed = abs(value - same) >= half
            else:
                same = (self.at[i] - zero) / frame.scale
                changed = not abs(value - same) < half
                changed |= further and arc and i in AXES[move.plane][:2]
            if not changed:
                if word is not None:
                    self.at[i] = zero + frame.scale * same
                found.append(None)
                continue
            text = grid.text(value)
            self.at[i] = zero + frame.scale * float(text)
            found.append(text)
        return found

    def _centre(self, move: Move, target: Target, start: list[float]) -> dict[str, float]:
        """Centre or radius, in the unit of the program, of the circle to be driven.

        It goes from the written start through the middle of the corrected path to the written end.
        """
        u, v, _ = AXES[move.plane]
        assert target.middle is not None
        a, b, c = ((p[u], p[v]) for p in (start, target.middle, self.at))
        x, y = centre_through(a, b, c)
        frame = move.frame
        if "R" in move.centre_words:
            return {"R": math.hypot(x, y) / frame.scale}
        zero = frame.origin if move.centre_absolute else start
        first, second = _CENTRE[move.plane]
        return {
            first: (start[u] + x - zero[u]) / frame.scale,
            second: (start[v] + y - zero[v]) / frame.scale,
        }

    # --- text -------------------------------------------------------------------------------------

    def _grid(self, frame: Frame) -> Grid:
        return self.grids[frame.scale != 1.0]

    def _style(self, block: Block) -> None:
        """Blanks between words and ends of lines as the program has them."""
        words = block.words
        if block.eol:
            self.eol = block.eol
        if len(words) > 1:
            between = block.text[words[-2].end : words[-1].start]
            self.separator = " " if between[:1] in (" ", "\t") else ""

    def _line(self, block: Block, words: list[str]) -> str:
        text = self.separator.join(words)
        return ("/" if block.deleted else "") + (text.lower() if _is_lower(block) else text)

    def _with_motion(self, block: Block, motion: int) -> str:
        edit = _Edit(block, self.separator)
        edit.before_axes(f"G{motion}")
        return edit.text()

    def _stop_words(self, block: Block) -> list[Word]:
        return [
            w
            for w in block.words
            if w.letter == "M" and w.value is not None and round(w.value) in codes.AFTER_MOTION
        ]

    def _stops(self, block: Block) -> list[str]:
        return [block.text[w.start : w.end] for w in self._stop_words(block)]

    def _note_codes(self, block: Block) -> None:
        known = codes.AFTER_MOTION | codes.BEFORE_MOTION
        for word in block.words:
            if word.letter == "M" and (word.value is None or round(word.value) not in known):
                self.displaced.setdefault(round(word.value or 0.0), []).append(block.line)


_ZEROS = ("0.0", "-0.0")
_PLACE = operator.itemgetter(0, 1)


def _is_lower(block: Block) -> bool:
    """Whether a word of the block is written in lower case."""
    text = block.text
    return not text.isupper() and any(text[w.start].islower() for w in block.words)


class _Edit:
    """Changes to the words of a block."""

    def __init__(self, block: Block, separator: str):
        self.block, self.separator = block, separator
        self.changes: dict[int, tuple[int, str]] = {}
        self.inserted: list[str] = []
        self.first: list[str] = []
        self.end: list[str] = []

    def replace(self, word: Word, text: str) -> None:
        self.changes[word.start] = (word.end, text)

    def remove(self, word: Word) -> None:
        """With the blanks before it."""
        start = word.start
        while start > 0 and self.block.text[start - 1] in " \t":
            start -= 1
        self.changes[start if start else word.start] = (word.end, "")

    def after_axes(self, text: str) -> None:
        self.inserted.append(text)

    def before_axes(self, text: str) -> None:
        self.first.append(text)

    def last(self, text: str) -> None:
        """After all words that describe the path."""
        self.end.append(text)

    def text(self) -> str:
        """The changed line."""
        parts: list[tuple[int, int, str]] = [(a, b, t) for a, (b, t) in self.changes.items()]
        if self.first or self.inserted or self.end:
            self._insert(parts)
        line, at, out = self.block.text, 0, ""
        if len(parts) > 1:
            parts.sort(key=_PLACE)
        for start, end, text in parts:
            out += line[at:start] + text
            at = end if end > at else max(at, start)
        return out + line[at:]

    def _insert(self, parts: list[tuple[int, int, str]]) -> None:
        words = self.block.words
        axes = [w for w in words if w.letter in _LETTERS]
        path = [w for w in words if w.letter in _PATH]
        g = [w for w in words if w.letter == "G"]
        if self.first:
            place = (axes or path)[0].start
            parts.append((place, -2, self._joined(self.first) + self.separator))
        if self.inserted:
            if axes:
                place, text = axes[-1].end, self.separator + self._joined(self.inserted)
            elif path:
                place, text = path[0].start, self._joined(self.inserted) + self.separator
            else:
                place, text = g[-1].end, self.separator + self._joined(self.inserted)
            parts.append((place, -1, text))
        if self.end:
            place = max(w.end for w in [*axes, *path])
            parts.append((place, -1, self.separator + self._joined(self.end)))

    def _joined(self, words: list[str]) -> str:
        text = self.separator.join(words)
        return text.lower() if _is_lower(self.block) else text
