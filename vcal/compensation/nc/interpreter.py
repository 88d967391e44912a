"""The modal state of a control (RS-274/NGC, clause 3.4), and what every block does to the position.

Positions are those of the axes, in mm. A position that cannot be known is None, with its cause.
"""

from ...errors import StudyError
from . import codes
from .arcs import AXES, Arc, centre_arc, radius_arc
from .blocks import Block, Word
from .moves import Cause, Frame, Left, Move, Point, arc_pieces, end_piece, line_piece, update
from .options import NcOptions

_AXES = "XYZ"
_OTHERS = frozenset("ABCUVW")
_CENTRE = {17: ("I", "J"), 18: ("K", "I"), 19: ("J", "K")}


class Interpreter:
    """Reads blocks in order. `read` gives a `Move` or a `Left` for each."""

    def __init__(self, options: NcOptions, name: str):
        self.options, self.name = options, name
        start = Cause(1, "the position at the start of the program is not known")
        self.causes: list[Cause] = [start]
        self.notes: dict[str, str] = {}
        """Assumptions that the program made necessary, by what they are about."""
        self.motion: int | None = None
        self.modal: Cause | None = None
        """Why the modal motion is none of G0 to G3: a canned cycle."""
        self.absolute: bool | None = True
        self.centre_absolute = False
        self.scale = 25.4 if options.units == "inch" else 1.0
        self.units_named = False
        self.plane: int | None = 17
        self.inverse_time = False
        self.system: str | None = "G54"
        self.offset: list[float] = []
        self.length = 0.0
        self.length_unknown: Cause | None = None
        self.compensated = False
        self.position: list[float | None] = [None] * 3
        self.unknown: list[Cause] = [start] * 3
        self.directions = [0.0, 0.0, 0.0]
        self.modes: dict[str, Cause] = {}
        self.shifted: set[int] = set()
        self.turned: set[str] = set()
        self.no_offsets: Cause | None = None
        self.no_modes: Cause | None = None
        """Why the modal states are not known: a call of a subprogram."""
        self.stopped: Cause | None = None
        """Why nothing from here on is read."""
        self.skipped: tuple[str, str] | None = None
        """Label and keyword of the control structure that is passed over."""
        self.ended = False
        self.percents = 0
        self.tool_numbers: dict[int, int] = {}

    # --- blocks -----------------------------------------------------------------------------------

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
            self._refuse(
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
            self._note("deleted", "blocks that begin with a slash are executed", block.line)
        return self._words(block)

    def _percent(self, block: Block) -> None:
        self.percents += 1
        if self.percents > 1:
            self.ended = True

    def _passed(self, block: Block) -> Left:
        if self.stopped and any(w.letter in _AXES for w in block.words):
            self._count(self.stopped, block)
        elif self.ended and block.kind == "words":
            self._after_end(block)
        return Left(block)

    def _after_end(self, block: Block) -> None:
        if any(w.letter in _AXES for w in block.words):
            self.stopped = self._cause(block.line, "blocks after the end of the program")
            self._count(self.stopped, block)

    def _flow(self, block: Block) -> Left:
        label, word = block.flow
        if self.skipped is None:
            text = f"O-word {word} {label}: control flow is not followed"
            self.flow_cause = self._cause(block.line, text, True)
            if word == "call":
                self._forget(self.flow_cause)
            elif word in ("sub", "if", "while", "do", "repeat"):
                self.skipped = (label, word)
            else:
                self._forget(self.flow_cause)
        elif block.kind == "flow" and label == self.skipped[0]:
            opened = self.skipped[1]
            if word == ("while" if opened == "do" else f"end{opened}"):
                self.skipped = None
                if opened != "sub":  # a definition is not executed in passing
                    self._forget(self.flow_cause)
        elif any(w.letter in _AXES for w in block.words):
            self._count(self.flow_cause, block)
        return Left(block)

    def _variables(self, block: Block) -> Left:
        cause = self._cause(block.line, _VARIABLES[block.kind], True)
        if block.kind == "macro":
            self.stopped = cause
        elif block.kind == "offsets":
            self.no_offsets = cause
            self._lose(range(3), cause)
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
            self._refuse(
                block.line, "a G word with a variable", "a G word with a number", "write it out"
            )
        assert word.value is not None
        tenths = round(10 * word.value)
        if tenths not in _KNOWN and tenths not in self.options.ignored:
            self._refuse(
                block.line,
                code_of(tenths),
                "a G code whose effect on the position is known",
                "if it moves no axis and changes no coordinates, name it in ignored_codes "
                "(--ignore-code)",
            )
        return tenths

    def _miscellaneous(self, block: Block, number: int) -> None:
        if number == codes.TOOL_CHANGE:
            self._lose(range(3), self._cause(block.line, "M6: a tool change may move the axes"))
        elif number in codes.CALLS:
            text = f"M{number}: a subprogram is called, which is taken to keep units and feed mode"
            self._forget(self._cause(block.line, text, True))

    # --- modal states -------------------------------------------------------------------------------

    def _act(
        self, block: Block, g: list[int], words: dict[int, Word], letters: dict[str, Word]
    ) -> Move | Left:
        axes = {i: letters[a] for i, a in enumerate(_AXES) if a in letters}
        for code in g:
            self._set(block, code, letters, axes)
        if self.compensated and "H" in letters and not codes.TOOL_LENGTHS.intersection(g):
            self._tool_length(block, 430, letters)
        motions = [c for c in g if c in codes.MOTIONS]
        if len(motions) < len(g):
            left = self._takes_axes(block, g, letters, axes)
            if left is not None:
                return left
        named = words[motions[-1]] if motions else None
        for letter in _OTHERS.intersection(letters):
            self._other_axis(block, letter, letters[letter])
        if not axes and not block.polar and not self._is_full_circle(letters):
            return Left(block, named, self.motion if named else None)
        return self._move(block, named, axes, letters)

    def _takes_axes(
        self, block: Block, g: list[int], letters: dict[str, Word], axes: dict[int, Word]
    ) -> Left | None:
        """A block with a code that uses the axis words itself."""
        if any(c in codes.NOT_MOVES for c in g) or codes.SETTING in g:
            if 40 in g and axes and ("P" in letters or any(c in codes.MOTIONS for c in g)):
                cause = self._cause(block.line, "G4 with axis words: controls read it differently")
                self._lose(range(3), cause)
                self._count(cause, block)
            return Left(block)
        for code in g:
            if code in codes.MOVES_OF_THE_CONTROL:
                if axes or code not in codes.OFTEN_WITHOUT_AXES:
                    return self._of_the_control(block, code, axes)
        used = (*codes.SHIFTS, *codes.MACRO_CALL, 431, 432)
        return Left(block) if any(c in used for c in g) else None

    def _is_full_circle(self, letters: dict[str, Word]) -> bool:
        return self.motion in (2, 3) and any(c in letters for c in "IJK")

    def _set(
        self, block: Block, code: int, letters: dict[str, Word], axes: dict[int, Word]
    ) -> None:
        line = block.line
        if code in codes.UNITS:
            self._units(block, code, letters)
        elif code in (900, 910):
            self.absolute = code == 900
        elif code in (901, 911):
            self.centre_absolute = code == 901
        elif code in (930, 940, 950):
            self.inverse_time = code == 930
        elif code in codes.OFFSETS:
            self._select(block, codes.OFFSETS[code])
        elif code in codes.EXTENDED_OFFSETS:
            number = letters["P"].value if "P" in letters else None
            if number is None:
                self._refuse(line, code_of(code), "a word P with the number", "add it")
            assert number is not None
            self._select(block, f"{codes.EXTENDED_OFFSETS[code]} P{round(number)}")
        elif code in codes.MOTIONS:
            self.motion, self.modal = codes.MOTIONS[code], None
        elif code in codes.CYCLES:
            text = f"{code_of(code)}: the positions of a canned cycle are not corrected"
            self.motion, self.modal = None, self._cause(line, text)
        elif code == codes.CANCEL:
            self.motion = self.modal = None
        elif code in codes.TOOL_LENGTHS:
            self._tool_length(block, code, letters)
        elif code == codes.SETTING:
            text = "G10 changes offsets: those given no longer apply"
            self.no_offsets = self._cause(line, text, True)
            self._lose(range(3), self.no_offsets)
        elif code in codes.SHIFTS:
            self._shift(block, code, axes)
        elif code in codes.ENDS_OF_SHIFTS:
            self._end_of_mode("shift")
            self.shifted.clear()
        elif code in codes.MACRO_CALL:
            self._forget(self._cause(line, f"{code_of(code)}: a macro is called", True))
        if code in codes.PLANES:
            self.plane = codes.PLANES[code]
        if code in codes.ENDS_OF_MODES:
            self._end_of_mode(codes.ENDS_OF_MODES[code])
        if code in codes.MODES:
            key, name = codes.MODES[code]
            self.modes[key] = self._cause(line, f"{code_of(code)}: {name}")

    def _units(self, block: Block, code: int, letters: dict[str, Word]) -> None:
        if code in (700, 710) and any(c in letters for c in "PQUWIJKLR"):
            self._refuse(
                block.line,
                f"{code_of(code)} with further words",
                "G70 and G71 as units (ISO 6983-1), not as cycles",
                "write the cycle out as moves",
            )
        self.scale, self.units_named = codes.UNITS[code], True

    def _select(self, block: Block, name: str) -> None:
        given = self.options.work_offsets_mm
        if given and name not in given:
            self._refuse(
                block.line,
                name,
                f"a work offset that was given ({', '.join(given)})",
                f"give the axis positions of the zero of {name}, in mm",
            )
        if not given and name != "G54":
            self._refuse(
                block.line,
                name,
                "only G54, as no work offsets were given",
                "give the axis positions of the zero of every work offset, in mm",
            )
        if self.system is not None and name != self.system:
            self.offset = []
        self.system = name

    def _tool_length(self, block: Block, code: int, letters: dict[str, Word]) -> None:
        lengths = self.options.tool_lengths_mm
        line, name = block.line, code_of(code)
        if code == 490 and not self.compensated:
            return
        self.compensated = code != 490
        text = f"{name} changes the tool length: some controls move Z at once, others later"
        if code in (430, 440) and (lengths is None or "H" in letters):
            number = letters["H"].value if "H" in letters else None
            self.length_unknown = None
            if number is not None:
                self.tool_numbers.setdefault(round(number), line)
            if lengths is not None:
                self.length = self._known_length(block, number) * (-1 if code == 440 else 1)
        elif code == 490 and lengths is not None:
            self.length, self.length_unknown = 0.0, None
        else:
            text = f"{name}: the tool length is not known from here on"
            self.length_unknown = self._cause(line, text)
        self._lose([2], self._cause(line, text))

    def _known_length(self, block: Block, number: float | None) -> float:
        lengths = self.options.tool_lengths_mm or {}
        if number is None or round(number) not in lengths:
            shown = "H with a variable" if number is None else f"H{round(number)}"
            given = ", ".join(f"H{n}" for n in lengths)
            self._refuse(block.line, shown, f"a tool length that was given ({given})", "add it")
        assert number is not None
        return float(lengths[round(number)])

    def _shift(self, block: Block, code: int, axes: dict[int, Word]) -> None:
        if code == 923 or axes:
            zero = code == 520 and all(w.value == 0.0 for w in axes.values())
            if zero and self.shifted <= set(axes):
                self.shifted.clear()
                self._end_of_mode("shift")
            else:
                self.shifted |= set(axes)
                text = f"{code_of(code)}: {codes.SHIFTS[code]}"
                self.modes["shift"] = self._cause(block.line, text)

    def _end_of_mode(self, key: str) -> None:
        cause = self.modes.pop(key, None)
        if cause is not None:
            self._lose(range(3), cause)

    def _other_axis(self, block: Block, letter: str, word: Word) -> None:
        """An axis beside X, Y, Z holds corrections back until it is at zero again."""
        if word.value == 0.0 and (self.absolute or letter not in self.turned):
            self.turned.discard(letter)
            if not self.turned and "axis" in self.modes:
                self.modes.pop("axis")
            return
        self.turned.add(letter)
        if "axis" not in self.modes:
            text = f"axis {letter} has moved; the displacement is known at its zero only"
            self.modes["axis"] = self._cause(block.line, text)

    # --- moves ------------------------------------------------------------------------------------

    def _frame(self, line: int) -> Frame:
        if not self.offset:
            given = self.options.work_offsets_mm
            if not given:
                text = "no work offset was given: program coordinates are axis positions"
                self._note("offset", text)
            elif self.system not in given:
                self._refuse(
                    line,
                    f"a move in {self.system}",
                    f"a move in a work offset that was given ({', '.join(given)})",
                    f"give the axis positions of the zero of {self.system}, in mm",
                )
            self.offset = [float(v) for v in given.get(self.system or "", (0.0, 0.0, 0.0))]
        x, y, z = self.offset
        return Frame(bool(self.absolute), self.scale, (x, y, z + self.length))

    def _held_back(self) -> Cause | None:
        """Why no move can be corrected now, whatever it is."""
        if self.modal is not None:
            return self.modal
        for cause in self.modes.values():
            return cause
        if self.absolute is None or self.plane is None or self.system is None:
            return self.no_modes
        return self.no_offsets

    def _of_the_control(self, block: Block, code: int, axes: dict[int, Word]) -> Left:
        cause = self._cause(block.line, f"{code_of(code)}: {codes.MOVES_OF_THE_CONTROL[code]}")
        self._count(cause, block)
        moved = list(axes) or [0, 1, 2]
        self._lose(moved, cause)
        return Left(block, sets=[(i, None) for i in moved])

    def _move(
        self, block: Block, named: Word | None, axes: dict[int, Word], letters: dict[str, Word]
    ) -> Move | Left:
        cause = self._held_back()
        if cause is None:
            cause = self._unreadable_move(block, letters)
        if cause is not None:
            rotary = self.modal is None and cause is self.modes.get("axis")
            return self._left(block, named, axes, cause, rotary and len(self.modes) == 1)
        if any(w.value is None for w in axes.values()):
            cause = self._cause(block.line, "variables and expressions are not evaluated")
            return self._left(block, named, axes, cause, known=True)
        frame = self._frame(block.line)
        end = self._end(frame, axes)
        missing = [i for i in range(3) if end[i] is None]
        if missing or self.length_unknown:
            cause = self.length_unknown or self.unknown[missing[0]]
            return self._left(block, named, axes, cause, known=True)
        return self._known_move(block, named, axes, letters, frame, [float(v or 0.0) for v in end])

    def _unreadable_move(self, block: Block, letters: dict[str, Word]) -> Cause | None:
        if self.motion is None:
            return self._cause(block.line, "axis words without a code of motion")
        if block.polar:
            return self._cause(block.line, "polar words are not read")
        single = [w for w in block.words if w.letter not in "GM"]
        if len(single) != sum(c not in "GM" for c in letters):
            return self._cause(block.line, "a letter occurs twice in a block")
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
        assert self.motion is not None and self.plane is not None
        begun = None not in self.position
        start = [float(v or 0.0) for v in self.position]
        tool = 1e-3 * self.length
        centre = {c: letters[c] for c in "IJKRP" if c in letters} if self.motion > 1 else {}
        if self.motion > 1:
            arc = self._arc(frame, start, end, centre) if begun else None
            if arc is None:
                text = "an arc whose circle is not determined by its words"
                cause = self._cause(block.line, text) if begun else self._first_unknown()
                return self._left(block, named, axes, cause, known=not begun)
            least = self.resolution_mm()
            pieces = arc_pieces(arc, start, end, self.directions, tool, least)
        elif self.motion == 0 or not begun or start == end:
            pieces = [end_piece(self.position, end, self.directions, tool)]
            if self.motion and not begun:
                text = "a feed from a position that is not known: only its end is corrected"
                self._cause(block.line, text, True)
        else:
            pieces = [line_piece(start, end, self.directions, tool)]
        self.position = [*end]
        if any(not _has_point(block.text, w) for w in axes.values()):
            text = "numbers without a decimal point are in the unit of the program"
            self._note("point", text, block.line)
        if not self.units_named:
            self._note("units", f"the program does not name its unit: {self.options.units}")
        feed = letters.get("F")
        inverse = feed.value if self.inverse_time and feed and self.motion else None
        return Move(
            block,
            self.motion,
            named,
            axes,
            frame,
            pieces,
            self.plane,
            centre,
            self.centre_absolute,
            inverse,
            feed,
        )

    def resolution_mm(self) -> float:
        """Of the output, in the units that are active."""
        inch = self.scale != 1.0
        return self.options.resolution_inch * 25.4 if inch else self.options.resolution_mm

    def _end(self, frame: Frame, axes: dict[int, Word]) -> list[float | None]:
        end = list(self.position)
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
        assert self.plane is not None
        if any(w.value is None for w in words.values()):
            return None
        values = {c: float(w.value or 0.0) for c, w in words.items()}
        ccw = self.motion == 3
        turns = values.get("P", 1.0)
        if turns < 1 or turns != round(turns):
            return None
        if "R" in values:
            if turns != 1 or any(c in values for c in "IJK"):
                return None
            return radius_arc(self.plane, ccw, start, end, frame.scale * values["R"])
        letters = _CENTRE[self.plane]
        if not any(c in values for c in letters) or set(values) - {*letters, "P"}:
            return None
        centre = []
        for letter, axis in zip(letters, AXES[self.plane][:2], strict=True):
            if self.centre_absolute and letter not in values:
                return None
            zero = frame.origin[axis] if self.centre_absolute else start[axis]
            centre.append(frame.scale * values.get(letter, 0.0) + zero)
        return centre_arc(self.plane, ccw, start, end, (centre[0], centre[1]), round(turns))

    def _left(
        self, block: Block, named: Word | None, axes: dict[int, Word], cause: Cause, known: bool
    ) -> Left:
        """A move that is left as it is. Its end may be known all the same."""
        self._count(cause, block)
        left = Left(block, named, self.motion)
        usable = known and self.absolute is not None and self.system is not None
        if not usable or self.no_offsets or self.motion is None:
            self._lose(range(3), cause)
            left.sets = [(i, None) for i in range(3)]
            return left
        frame = left.frame = self._frame(block.line)
        if self.motion > 1 and frame.absolute and self.plane is not None:
            at = [(i, self.position[i]) for i in AXES[self.plane][:2]]
            left.back_to = [(i, p) for i, p in at if p is not None]
        before = list(self.position)
        end = self._end(frame, axes)
        if self.length_unknown and 2 in axes:
            end[2] = None
        for i, word in axes.items():
            if end[i] is None:
                self._lose([i], cause if word.value is None else self.unknown[i])
        left.by = not frame.absolute
        for i, word in axes.items():
            value = end[i]
            step = None if word.value is None else frame.scale * word.value
            left.sets.append((i, step if left.by and value is not None else value))
        self.position = end
        ways = [0.0 if a is None or b is None else b - a for a, b in zip(before, end, strict=True)]
        update(self.directions, ways)
        if self.motion > 1 and self.plane is not None:
            for i in AXES[self.plane][:2]:
                self.directions[i] = 0.0
        return left

    # --- what is not known ---------------------------------------------------------------------------

    def _first_unknown(self) -> Cause:
        return next(self.unknown[i] for i in range(3) if self.position[i] is None)

    def _lose(self, axes: "range | list[int]", cause: Cause) -> None:
        for i in axes:
            self.position[i] = None
            self.unknown[i] = cause
            self.directions[i] = 0.0

    def _forget(self, cause: Cause) -> None:
        """Position, motion, distance mode, plane and work offset are not known from here on."""
        self._lose(range(3), cause)
        self.motion = self.modal = self.absolute = self.plane = self.system = None
        self.offset = []
        self.no_modes = cause

    def _cause(self, line: int, text: str, always: bool = False) -> Cause:
        cause = Cause(line, text, always)
        self.causes.append(cause)
        return cause

    def _count(self, cause: Cause, block: Block) -> None:
        cause.moves += 1
        cause.last = block.line

    def _note(self, key: str, text: str, line: int | None = None) -> None:
        if key not in self.notes:
            self.notes[key] = text + (f" (first in line {line})" if line else "")

    def _refuse(self, line: int, found: str, expected: str, do: str) -> None:
        raise StudyError(f"{self.name}, line {line}: found {found}, expected {expected}; {do}")


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


def code_of(tenths: int) -> str:
    """The G code of a number of tenths."""
    return codes.code_name("G", tenths)


def _has_point(text: str, word: Word) -> bool:
    return "." in text[word.start : word.end]
