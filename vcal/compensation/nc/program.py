"""Correct a whole NC program, some thousand blocks at a time."""

import contextlib
import gc
import os
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from ...errors import StudyError
from ...files import naming
from ...words import counted
from . import blocks
from .interpreter import Interpreter
from .moves import Left, Move, Piece
from .options import Displacement, NcOptions
from .report import NcReport, NcWarning, warnings_of
from .split import sample_count, split
from .write import Writer

_BLOCKS, _SAMPLES = 5_000, 100_000
"""Blocks and samples that are held at once."""


@dataclass(frozen=True)
class CorrectedProgram:
    """A corrected program and its report."""

    program: bytes
    report: NcReport


def correct_program(
    program: bytes,
    displacement: Displacement,
    options: NcOptions | None = None,
    name: str = "program",
) -> CorrectedProgram:
    """The program with every commanded position q replaced by q + c, where the displaced tool point
    is the programmed one:

        q + c + displacement(q + c) = q

    Straight lines and arcs are split where the corrected path deviates from a straight line or an
    arc by more than the tolerance. All other bytes stay. Raises `StudyError` for a
    program that cannot be read.
    """
    correction = _Correction(displacement, options or NcOptions(), name)
    with _uncollected():
        text = "".join(correction.texts(_decoded(program, name)))
    return CorrectedProgram(text.encode("latin-1"), correction.report())


def correct_file(
    path: Path, out: Path, displacement: Displacement, options: NcOptions | None = None
) -> NcReport:
    """`correct_program` from file to file; an existing `out` is replaced once all is written.

    Raises `StudyError` for a program that cannot be read, and where `out` is the program itself.
    """
    if not path.is_file():
        raise StudyError(f"{path}: found no file, expected an NC program; check the path")
    if out.exists() and out.samefile(path):
        raise StudyError(
            f"{out}: found the program itself, expected another file for the corrected one; "
            "give another name, as a program must not be corrected twice"
        )
    correction = _Correction(displacement, options or NcOptions(), path.name)
    text = _decoded(path.read_bytes(), path.name)
    try:
        handle, kept = tempfile.mkstemp(dir=out.parent, prefix=out.name)
    except OSError as error:
        raise StudyError(
            f"{out}: found a folder that cannot be written to ({error.strerror}), expected a place "
            "for the corrected program; give another one"
        ) from None
    try:
        with (
            naming(out),
            _uncollected(),
            os.fdopen(handle, "w", encoding="latin-1", newline="") as file,
        ):
            for part in correction.texts(text):
                file.write(part)
        os.chmod(kept, path.stat().st_mode & 0o777)
        os.replace(kept, out)
    except BaseException:
        os.unlink(kept)
        raise
    return correction.report()


def _decoded(program: bytes, name: str) -> str:
    """Latin-1 gives every byte back; what is not ASCII stands in comments only."""
    begin = program.lstrip(b"\0")[:400]  # NUL is a tape leader
    if begin[:2] in (b"\xff\xfe", b"\xfe\xff") or 4 * begin.count(b"\0") > len(begin):
        raise StudyError(
            f"{name}: found UTF-16 or binary data, expected a text of one byte per character, as "
            "controls read it; save the program as ASCII or UTF-8"
        )
    return program.decode("latin-1")


@contextlib.contextmanager
def _uncollected() -> Iterator[None]:
    """Without the collector of cycles: there are none here, and it took a third of the time."""
    enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if enabled:
            gc.enable()


class _Correction:
    """The state between blocks, and the counts for the report."""

    def __init__(self, displacement: Displacement, options: NcOptions, name: str):
        self.displacement, self.options, self.name = displacement, options, name
        self.interpreter = Interpreter(options, name)
        self.writer = Writer(options)
        self.largest, self.largest_line = 0.0, 0
        self.lines_in = self.lines_out = self.moves = 0
        self.too_fast: list[int] = []

    def texts(self, program: str) -> Iterator[str]:
        """The corrected program in parts."""
        held: list[Move | Left] = []
        samples = 0
        for line, text, eol in blocks.lines(program):
            step = self.interpreter.read(blocks.read_block(line, text, eol))
            held.append(step)
            if isinstance(step, Move):
                samples += sum(sample_count(piece, self.options) + 1 for piece in step.pieces)
            if len(held) >= _BLOCKS or samples >= _SAMPLES:
                yield self._written(held)
                held, samples = [], 0
        yield self._written(held)

    def _written(self, steps: list[Move | Left]) -> str:
        pieces: list[Piece] = []
        for step in steps:
            if isinstance(step, Move):
                pieces += step.pieces
        splitting = split(pieces, self.displacement, self.options) if pieces else None
        sizes = splitting.largest.tolist() if splitting else []
        at, out = 0, []
        for step in steps:
            self.lines_in += 1
            if isinstance(step, Left) or splitting is None:
                assert isinstance(step, Left)
                text = self.writer.left(step)
            else:
                rows = slice(at, at + len(step.pieces))
                at = rows.stop
                largest = max(sizes[rows])
                if largest > self.largest:
                    self.largest, self.largest_line = largest, step.block.line
                self.moves += 1
                text = self.writer.move(step, splitting.spans[rows], largest)
                if splitting.unresolved:
                    bad = set(range(rows.start, rows.stop)).intersection(splitting.unresolved)
                    self.too_fast += [step.block.line] if bad else []
            out.append(text)
            self.lines_out += max(text.count("\n"), text.count("\r"), 1)
        return "".join(out)

    def report(self) -> NcReport:
        """The report of what has been read so far."""
        state, writer = self.interpreter.state, self.writer
        causes = state.causes
        left = sum(cause.moves for cause in causes)
        warnings = [*warnings_of(causes), *self._own_warnings()]
        assumptions = dict(state.notes)
        if state.tool_numbers and self.options.tool_lengths_mm is None:
            tools = ", ".join(f"H{number}" for number in sorted(state.tool_numbers))
            assumptions["tool"] = (
                f"the tool of the calibration for {tools}, as no lengths were given"
            )
        return NcReport(
            self.name,
            1e3 * self.largest,
            self.largest_line,
            self.lines_in,
            self.lines_out,
            self.moves + left,
            writer.corrected,
            writer.split,
            left,
            tuple(sorted(warnings, key=lambda w: w.lines[0])),
            tuple(assumptions.values()),
        )

    def _own_warnings(self) -> Iterator[NcWarning]:
        if outside := self.interpreter.outside:
            axes = sorted({axis for _, found in outside for axis in found})
            travels = dict(zip("XYZ", self.options.travels_mm, strict=True))
            ends = ", ".join(f"{a} {travels[a][0]:.6g} to {travels[a][1]:.6g} mm" for a in axes)
            last, many = outside[-1][0], counted(len(outside), "move")
            text = (
                f"{many} up to line {last} beyond the calibrated travels ({ends}), where errors "
                "are extrapolated"
            )
            yield NcWarning(tuple(line for line, _ in outside[:5]), text, 0, last)
        if self.too_fast:
            text = "the correction changes too fast along the move to keep the tolerance"
            yield NcWarning(tuple(self.too_fast[:5]), text, 0, self.too_fast[-1])
        for number, lines in self.writer.displaced.items():
            text = f"M{number} stands in a block that was split, and is now in the first part"
            yield NcWarning(tuple(lines[:5]), text, 0, lines[-1])
