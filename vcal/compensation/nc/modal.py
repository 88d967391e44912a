"""The modal state of a control (RS-274/NGC, clause 3.4), with what is not known of it.

Positions are those of the axes, in mm. A position that cannot be known is None, with its cause.
"""

from typing import NoReturn

from ...errors import StudyError
from . import codes
from .blocks import Block, Word
from .codes import code_of
from .moves import Cause, Frame
from .options import NcOptions


class ModalState:
    """What stays from block to block. `take` changes it as a G code does."""

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
        self.tool_numbers: dict[int, int] = {}

    def begin_block(self) -> None:
        """What the block before has ended."""
        if not self.turned and "axis" in self.modes:
            self.modes.pop("axis")

    def take(
        self, block: Block, code: int, letters: dict[str, Word], axes: dict[int, Word]
    ) -> None:
        """A G code: what it changes in the modal state."""
        if code in codes.MOTIONS:  # first, as nearly every block has one
            self.motion, self.modal = codes.MOTIONS[code], None
            return
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
                self.refuse(line, code_of(code), "a word P with the number", "add it")
            self._select(block, f"{codes.EXTENDED_OFFSETS[code]} P{round(number)}")
        elif code in codes.CYCLES:
            text = f"{code_of(code)}: the positions of a canned cycle are not corrected"
            self.motion, self.modal = None, self.cause(line, text)
        elif code == codes.CANCEL:
            self.motion = self.modal = None
        elif code in codes.TOOL_LENGTHS:
            self.tool_length(block, code, letters)
        elif code == codes.SETTING:
            text = "G10 changes offsets: those given no longer apply"
            self.no_offsets = self.cause(line, text, True)
            self.lose(range(3), self.no_offsets)
        elif code in codes.SHIFTS:
            self._shift(block, code, axes)
        elif code in codes.ENDS_OF_SHIFTS:
            self._end_of_mode("shift")
            self.shifted.clear()
        elif code in codes.MACRO_CALL:
            self.forget(self.cause(line, f"{code_of(code)}: a macro is called", True))
        if code in codes.PLANES:
            self.plane = codes.PLANES[code]
        if code in codes.ENDS_OF_MODES:
            self._end_of_mode(codes.ENDS_OF_MODES[code])
        if code in codes.MODES:
            key, name = codes.MODES[code]
            self.modes[key] = self.cause(line, f"{code_of(code)}: {name}")

    def _units(self, block: Block, code: int, letters: dict[str, Word]) -> None:
        if code in (700, 710) and any(c in letters for c in "PQUWIJKLR"):
            self.refuse(
                block.line,
                f"{code_of(code)} with further words",
                "G70 and G71 as units (ISO 6983-1), not as cycles",
                "write the cycle out as moves",
            )
        self.scale, self.units_named = codes.UNITS[code], True

    def _select(self, block: Block, name: str) -> None:
        given = self.options.work_offsets_mm
        if given and name not in given:
            self.refuse(
                block.line,
                name,
                f"a work offset that was given ({', '.join(given)})",
                f"give the axis positions of the zero of {name}, in mm",
            )
        if not given and name != "G54":
            self.refuse(
                block.line,
                name,
                "only G54, as no work offsets were given",
                "give the axis positions of the zero of every work offset, in mm",
            )
        if self.system is not None and name != self.system:
            self.offset = []
        self.system = name

    def tool_length(self, block: Block, code: int, letters: dict[str, Word]) -> None:
        """G43, G44 or G49. Controls differ in whether Z moves at once."""
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
            self.length_unknown = self.cause(line, text)
        self.lose([2], self.cause(line, text))

    def _known_length(self, block: Block, number: float | None) -> float:
        lengths = self.options.tool_lengths_mm or {}
        if number is None or round(number) not in lengths:
            shown = "H with a variable" if number is None else f"H{round(number)}"
            given = ", ".join(f"H{n}" for n in lengths)
            self.refuse(block.line, shown, f"a tool length that was given ({given})", "add it")
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
                self.modes["shift"] = self.cause(block.line, text)

    def _end_of_mode(self, key: str) -> None:
        cause = self.modes.pop(key, None)
        if cause is not None:
            self.lose(range(3), cause)

    def other_axis(self, block: Block, letter: str, word: Word) -> None:
        """An axis beside X, Y, Z holds corrections back until it is at zero again."""
        if word.value == 0.0 and (self.absolute or letter not in self.turned):
            self.turned.discard(letter)
            return
        self.turned.add(letter)
        if "axis" not in self.modes:
            text = f"axis {letter} has moved; the displacement is known at its zero only"
            self.modes["axis"] = self.cause(block.line, text)

    def frame(self, line: int) -> Frame:
        """How coordinates are read now."""
        if not self.offset:
            given = self.options.work_offsets_mm
            if not given:
                text = "no work offset was given: program coordinates are axis positions"
                self.note("offset", text)
            elif self.system not in given:
                self.refuse(
                    line,
                    f"a move in {self.system}",
                    f"a move in a work offset that was given ({', '.join(given)})",
                    f"give the axis positions of the zero of {self.system}, in mm",
                )
            self.offset = [float(v) for v in given.get(self.system or "", (0.0, 0.0, 0.0))]
        x, y, z = self.offset
        return Frame(bool(self.absolute), self.scale, (x, y, z + self.length))

    def held_back(self) -> Cause | None:
        """Why no move can be corrected now, whatever it is."""
        if self.modal is not None:
            return self.modal
        for cause in self.modes.values():
            return cause
        if self.absolute is None or self.plane is None or self.system is None:
            return self.no_modes
        return self.no_offsets

    def resolution_mm(self) -> float:
        """Of the output, in the units that are active."""
        inch = self.scale != 1.0
        return self.options.resolution_inch * 25.4 if inch else self.options.resolution_mm

    def lose(self, axes: "range | list[int]", cause: Cause) -> None:
        """The position of axes is not known from here on."""
        for i in axes:
            self.position[i] = None
            self.unknown[i] = cause
            self.directions[i] = 0.0

    def forget(self, cause: Cause) -> None:
        """Position, motion, distance mode, plane and work offset are not known from here on."""
        self.lose(range(3), cause)
        self.motion = self.modal = self.absolute = self.plane = self.system = None
        self.offset = []
        self.no_modes = cause

    def cause(self, line: int, text: str, always: bool = False) -> Cause:
        """A new reason for which moves are left as they are."""
        cause = Cause(line, text, always)
        self.causes.append(cause)
        return cause

    def count(self, cause: Cause, block: Block) -> None:
        """One more move that is left as it is."""
        cause.moves += 1
        cause.last = block.line

    def note(self, key: str, text: str, line: int | None = None) -> None:
        """An assumption, once per key."""
        if key not in self.notes:
            self.notes[key] = text + (f" (first in line {line})" if line else "")

    def refuse(self, line: int, found: str, expected: str, do: str) -> NoReturn:
        """Raise `StudyError`."""
        raise StudyError(f"{self.name}, line {line}: found {found}, expected {expected}; {do}")

    def first_unknown(self) -> Cause:
        """Why the position is not known."""
        return next(self.unknown[i] for i in range(3) if self.position[i] is None)
