"""What every block of a program does to the position of the axes, in mm."""

from . import codes
from .arcs import AXES, Arc, centre_arc, radius_arc
from .blocks import Block, Word
from .codes import code_of
from .modal import ModalState
from .moves import Cause, Frame, Left, Move, Point, arc_pieces, end_piece, line_piece, update
from .options import NcOptions

_AXES = "XYZ"
_OTHERS = frozenset("ABCUVW")
_CENTRES = frozenset("IJKR")
_FARTHEST_MM = 1e5
"""No machine is longer; a larger number is a slip, or of another unit."""
_OUTSIDE_MM = 1e-3
_MOST_TURNS = 1000
_CENTRE = {17: ("I", "J"), 18: ("K", "I"), 19: ("J", "K")}


class Interpreter:
    """Reads blocks in order. `read` gives a `Move` or a `Left` for each."""

    def __init__(self, options: NcOptions, name: str):
        self.options = options
        self.state = ModalState(options, name)
        self.stopped: Cause | None = None
        """Why nothing from here on is read."""
        self.skipped: tuple[str, str] | None = None
        """Label and keyword of the control structure that is passed over."""
        self.flow_cause = Cause(0, "")
        self.ended = False
        self.percents = 0
        self.outside: list[tuple[int, list[str]]] = []
        """Lines whose moves end outside of the calibrated travels, with the axes."""

    def read(self, block: Block) -> Move | Left:
        """What a block does. Raises `StudyError` for one that cannot be read."""
        if block.kind == "percent":
            self._percent(block)
            return Left(block)
        if self.ended or self.stopped or (self.options.skip_deleted and block.deleted):
            return self._passed(block)
        if self.skipped or block.kind == "flow":
            return self._flow(block)
        if block.kind == "unreadable":
            self.state.refuse(
                block.line,
                repr(block.found[:40]),
                "words of a letter and a number, such as X10.5",
                "correct the block, or make it a comment",
            )
        if block.kind != "words":
            return self._variables(block)
        if not block.words and not block.polar:
            return Left(block)
        if block.deleted:
            self.state.note("deleted", "blocks that begin with a slash are executed", block.line)
        return self._words(block)

    def _percent(self, block: Block) -> None:
        self.percents += 1
        if self.percents > 1:
            self.ended = True

    def _passed(self, block: Block) -> Left:
        if self.stopped and any(w.letter in _AXES for w in block.words):
            self.state.count(self.stopped, block)
        elif self.ended and block.kind == "words":
            self._after_end(block)
        return Left(block)

    def _after_end(self, block: Block) -> None:
        if any(w.letter in _AXES for w in block.words):
            self.stopped = self.state.cause(block.line, "blocks after the end of the program")
            self.state.count(self.stopped, block)

    def _flow(self, block: Block) -> Left:
        label, word = block.flow
        if self.skipped is None:
            text = f"O-word {word} {label}: control flow is not followed"
            self.flow_cause = self.state.cause(block.line, text, True)
            if word == "call":
                self.state.forget(self.flow_cause)
            elif word in ("sub", "if", "while", "do", "repeat"):
                self.skipped = (label, word)
            else:
                self.state.forget(self.flow_cause)
        elif block.kind == "flow" and label == self.skipped[0]:
            opened = self.skipped[1]
            if word == ("while" if opened == "do" else f"end{opened}"):
                self.skipped = None
                if opened != "sub":  # a definition is not executed in passing
                    self.state.forget(self.flow_cause)
        elif any(w.letter in _AXES for w in block.words):
            self.state.count(self.flow_cause, block)
        return Left(block)

    def _variables(self, block: Block) -> Left:
        cause = self.state.cause(block.line, _VARIABLES[block.kind], True)
        if block.kind == "macro":
            self.stopped = cause
        elif block.kind == "offsets":
            self.state.no_offsets = cause
            self.state.lose(range(3), cause)
        return Left(block)

    def _words(self, block: Block) -> Move | Left:
        g: list[tuple[int, Word]] = []
        m: list[int] = []
        for word in block.words:
            if word.letter == "G":
                g.append((self._code(block, word), word))
            elif word.letter == "M" and word.value is not None:
                m.append(round(word.value))
        letters = {word.letter: word for word in block.words}
        for number in m:
            self._miscellaneous(block, number)
        result = self._act(block, [c for c, _ in g], dict(g), letters)
        if codes.ENDS.intersection(m):
            self.ended = True
        return result

    def _code(self, block: Block, word: Word) -> int:
        if word.value is None:
            self.state.refuse(
                block.line, "a G word with a variable", "a G word with a number", "write it out"
            )
        tenths = round(10 * word.value)
        if tenths not in _KNOWN and tenths not in self.options.ignored:
            self.state.refuse(
                block.line,
                code_of(tenths),
                "a G code whose effect on the position is known",
                "if it moves no axis and changes no coordinates, name it in ignored_codes "
                "(--ignore-code)",
            )
        return tenths

    def _miscellaneous(self, block: Block, number: int) -> None:
        if number == codes.TOOL_CHANGE:
            self.state.lose(
                range(3), self.state.cause(block.line, "M6: a tool change may move the axes")
            )
        elif number in codes.CALLS:
            text = f"M{number}: a subprogram is called, which is taken to keep units and feed mode"
            self.state.forget(self.state.cause(block.line, text, True))

    def _act(
        self, block: Block, g: list[int], words: dict[int, Word], letters: dict[str, Word]
    ) -> Move | Left:
        axes = {i: letters[a] for i, a in enumerate(_AXES) if a in letters}
        self.state.begin_block()
        for code in sorted(g, key=_order) if len(g) > 1 else g:
            self.state.take(block, code, letters, axes)
        if self.state.compensated and "H" in letters and not codes.TOOL_LENGTHS.intersection(g):
            self.state.tool_length(block, 430, letters)
        motions = [c for c in g if c in codes.MOTIONS]
        named = words[motions[-1]] if motions else None
        if len(motions) < len(g):
            left = self._takes_axes(block, g, letters, axes)
            if left is not None:
                left.named, left.motion = named, self.state.motion if named else None
                return left
        for letter in sorted(_OTHERS.intersection(letters)):
            self.state.other_axis(block, letter, letters[letter])
        if not axes and not block.polar and not self._is_full_circle(letters):
            return Left(block, named, self.state.motion if named else None)
        return self._move(block, named, axes, letters)

    def _takes_axes(
        self, block: Block, g: list[int], letters: dict[str, Word], axes: dict[int, Word]
    ) -> Left | None:
        """A block with a code that uses the axis words itself."""
        if any(c in codes.NOT_MOVES for c in g) or codes.SETTING in g:
            if 40 in g and axes and ("P" in letters or any(c in codes.MOTIONS for c in g)):
                cause = self.state.cause(
                    block.line, "G4 with axis words: controls read it differently"
                )
                self.state.lose(range(3), cause)
                self.state.count(cause, block)
            return Left(block)
        for code in g:
            if code in codes.MOVES_OF_THE_CONTROL:
                if axes or code not in codes.OFTEN_WITHOUT_AXES:
                    return self._of_the_control(block, code, axes)
        used = (*codes.SHIFTS, *codes.MACRO_CALL, 431, 432)
        return Left(block) if any(c in used for c in g) else None

    def _is_full_circle(self, letters: dict[str, Word]) -> bool:
        return self.state.motion in (2, 3) and any(c in letters for c in "IJK")

    def _of_the_control(self, block: Block, code: int, axes: dict[int, Word]) -> Left:
        cause = self.state.cause(block.line, f"{code_of(code)}: {codes.MOVES_OF_THE_CONTROL[code]}")
        self.state.count(cause, block)
        moved = list(axes) or [0, 1, 2]
        self.state.lose(moved, cause)
        return Left(block, sets=[(i, None) for i in moved])

    def _move(
        self, block: Block, named: Word | None, axes: dict[int, Word], letters: dict[str, Word]
    ) -> Move | Left:
        cause = self.state.held_back()
        if cause is None:
            cause = self._unreadable_move(block, letters)
        if cause is not None:
            rotary = self.state.modal is None and cause is self.state.modes.get("axis")
            return self._left(block, named, axes, cause, rotary and len(self.state.modes) == 1)
        if "E" in letters:
            cause = self.state.cause(block.line, "E (thread lead, extrusion) beside axis words")
            return self._left(block, named, axes, cause, known=True)
        if any(w.value is None for w in axes.values()):
            cause = self.state.cause(block.line, "variables and expressions are not evaluated")
            return self._left(block, named, axes, cause, known=True)
        frame = self.state.frame(block.line)
        end = self._end(frame, axes)
        self._check_near(block.line, end)
        missing = [i for i in range(3) if end[i] is None]
        if missing or self.state.length_unknown:
            cause = self.state.length_unknown or self.state.unknown[missing[0]]
            return self._left(block, named, axes, cause, known=True)
        return self._known_move(block, named, axes, letters, frame, [float(v or 0.0) for v in end])

    def _unreadable_move(self, block: Block, letters: dict[str, Word]) -> Cause | None:
        if self.state.motion is None:
            return self.state.cause(block.line, "axis words without a code of motion")
        if self.state.motion < 2 and not _CENTRES.isdisjoint(letters):
            return self.state.cause(block.line, "words I, J, K or R in a straight move")
        if block.polar:
            return self.state.cause(block.line, "polar words are not read")
        twice = len(block.words) != len(letters)
        if twice and sum(w.letter not in "GM" for w in block.words) != len({*letters} - {*"GM"}):
            return self.state.cause(block.line, "a letter occurs twice in a block")
        return None

    def _known_move(
        self,
        block: Block,
        named: Word | None,
        axes: dict[int, Word],
        letters: dict[str, Word],
        frame: Frame,
        end: Point,
    ) -> Move | Left:
        assert self.state.motion is not None and self.state.plane is not None
        begun = None not in self.state.position
        start = [float(v or 0.0) for v in self.state.position]
        tool = 1e-3 * self.state.length
        centre = {c: letters[c] for c in "IJKRP" if c in letters} if self.state.motion > 1 else {}
        if self.state.motion > 1:
            arc = self._arc(frame, start, end, centre) if begun else None
            if arc is not None and max(arc.radius) > _FARTHEST_MM:
                arc = None
            if arc is None:
                text = "an arc whose circle is not determined by its words"
                cause = self.state.cause(block.line, text) if begun else self.state.first_unknown()
                return self._left(block, named, axes, cause, known=not begun)
            least = self.state.resolution_mm()
            pieces = arc_pieces(arc, start, end, self.state.directions, tool, least)
        elif self.state.motion == 0 or not begun or start == end:
            pieces = [end_piece(self.state.position, end, self.state.directions, tool)]
            if self.state.motion and not begun:
                text = "a feed from a position that is not known: only its end is corrected"
                self.state.cause(block.line, text, True)
        else:
            pieces = [line_piece(start, end, self.state.directions, tool)]
        if self.options.travels_mm:
            self._note_outside(block, end)
        self.state.position = [*end]
        if "point" not in self.state.notes and _without_point(block.text, axes):
            text = "numbers without a decimal point are in the unit of the program"
            self.state.note("point", text, block.line)
        if not self.state.units_named:
            self.state.note("units", f"the program does not name its unit: {self.options.units}")
        feed = letters.get("F")
        inverse = feed.value if self.state.inverse_time and feed and self.state.motion else None
        return Move(
            block,
            self.state.motion,
            named,
            axes,
            frame,
            pieces,
            self.state.plane,
            centre,
            self.state.centre_absolute,
            inverse,
            feed,
        )

    def _check_near(self, line: int, end: list[float | None]) -> None:
        for axis, at in zip(_AXES, end, strict=True):
            if at is not None and not abs(at) <= _FARTHEST_MM:
                self.state.refuse(
                    line,
                    f"the axis position {axis} = {at:.6g} mm",
                    f"one within {_FARTHEST_MM:g} mm of zero",
                    "correct the number, the unit or the work offset",
                )

    def _note_outside(self, block: Block, end: Point) -> None:
        """Count a move that ends outside of the calibrated travels."""
        travels = zip(_AXES, end, self.options.travels_mm, strict=True)
        outside = [
            a for a, at, (low, high) in travels if not low - _OUTSIDE_MM <= at <= high + _OUTSIDE_MM
        ]
        if outside:
            self.outside.append((block.line, outside))

    def _end(self, frame: Frame, axes: dict[int, Word]) -> list[float | None]:
        end = list(self.state.position)
        for i, word in axes.items():
            value = None if word.value is None else frame.scale * word.value
            at = end[i]
            if value is None:
                end[i] = None
            elif frame.absolute:
                end[i] = value + frame.origin[i]
            else:
                end[i] = None if at is None else at + value
        return end

    def _arc(self, frame: Frame, start: Point, end: Point, words: dict[str, Word]) -> Arc | None:
        assert self.state.plane is not None
        if any(w.value is None for w in words.values()):
            return None
        values = {c: float(w.value or 0.0) for c, w in words.items()}
        ccw = self.state.motion == 3
        turns = values.get("P", 1.0)
        if not 1 <= turns <= _MOST_TURNS or turns != round(turns):
            return None
        if "R" in values:
            if turns != 1 or any(c in values for c in "IJK"):
                return None
            return radius_arc(self.state.plane, ccw, start, end, frame.scale * values["R"])
        letters = _CENTRE[self.state.plane]
        if not any(c in values for c in letters) or set(values) - {*letters, "P"}:
            return None
        centre = []
        for letter, axis in zip(letters, AXES[self.state.plane][:2], strict=True):
            if self.state.centre_absolute and letter not in values:
                return None
            zero = frame.origin[axis] if self.state.centre_absolute else start[axis]
            centre.append(frame.scale * values.get(letter, 0.0) + zero)
        return centre_arc(self.state.plane, ccw, start, end, (centre[0], centre[1]), round(turns))

    def _left(
        self, block: Block, named: Word | None, axes: dict[int, Word], cause: Cause, known: bool
    ) -> Left:
        """A move that is left as it is. Its end may be known all the same."""
        self.state.count(cause, block)
        left = Left(block, named, self.state.motion)
        usable = known and self.state.absolute is not None and self.state.system is not None
        if not usable or self.state.no_offsets or self.state.motion is None:
            self.state.lose(range(3), cause)
            left.sets = [(i, None) for i in range(3)]
            return left
        frame = left.frame = self.state.frame(block.line)
        if self.state.motion > 1 and frame.absolute and self.state.plane is not None:
            at = [(i, self.state.position[i]) for i in AXES[self.state.plane][:2]]
            left.back_to = [(i, p) for i, p in at if p is not None]
        before = list(self.state.position)
        end = self._end(frame, axes)
        if self.state.length_unknown and 2 in axes:
            end[2] = None
        for i, word in axes.items():
            if end[i] is None:
                self.state.lose([i], cause if word.value is None else self.state.unknown[i])
        left.by = not frame.absolute
        for i, word in axes.items():
            value = end[i]
            step = None if word.value is None else frame.scale * word.value
            left.sets.append((i, step if left.by and value is not None else value))
        self.state.position = end
        ways = [0.0 if a is None or b is None else b - a for a, b in zip(before, end, strict=True)]
        update(self.state.directions, ways)
        if self.state.motion > 1 and self.state.plane is not None:
            for i in AXES[self.state.plane][:2]:
                self.state.directions[i] = 0.0
        return left


_VARIABLES = {
    "macro": "IF, WHILE, GOTO or assignments in a block: what is executed after it is not known",
    "assignment": "variables are assigned; words that use them are not corrected",
    "offsets": "a variable that may be a work offset is assigned: those given no longer apply",
}
_KNOWN = (
    codes.HARMLESS
    | codes.NOT_MOVES
    | codes.CYCLES
    | codes.TOOL_LENGTHS
    | codes.ENDS_OF_SHIFTS
    | codes.MACRO_CALL
    | {900, 910, 901, 911, 930, 940, 950, codes.SETTING, codes.CANCEL}
    | codes.PLANES.keys()
    | codes.UNITS.keys()
    | codes.MOTIONS.keys()
    | codes.OFFSETS.keys()
    | codes.EXTENDED_OFFSETS.keys()
    | codes.MOVES_OF_THE_CONTROL.keys()
    | codes.MODES.keys()
    | codes.ENDS_OF_MODES.keys()
    | codes.SHIFTS.keys()
)


def _order(code: int) -> int:
    """G80 before, and a code of motion after the other codes of a block, wherever it stands."""
    return 0 if code == codes.CANCEL else 2 if code in _OF_MOTION else 1


_OF_MOTION = codes.CYCLES | codes.MOTIONS.keys()


def _without_point(text: str, axes: dict[int, Word]) -> bool:
    return any("." not in text[word.start : word.end] for word in axes.values())
