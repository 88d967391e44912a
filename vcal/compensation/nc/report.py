"""What was corrected in an NC program, and what was not."""

from dataclasses import dataclass

from ...words import counted, printable
from .moves import Cause


@dataclass(frozen=True)
class NcWarning:
    """Moves that were left as they are, or whose correction is uncertain, for one reason."""

    lines: tuple[int, ...]
    """Where the reason stands in the program: first lines, at most five."""
    text: str
    moves: int
    """Number of moves that were left as they are."""
    last: int
    """Line of the last of them."""

    def __str__(self) -> str:
        where = ", ".join(map(str, self.lines))
        many = f" ({counted(self.moves, 'move')} up to line {self.last} left as they are)"
        one = f" (line {self.last} left as it is)"
        what = "" if not self.moves else one if self.moves == 1 else many
        return f"{'line' if len(self.lines) == 1 else 'lines'} {where}: {self.text}{what}"


@dataclass(frozen=True)
class NcReport:
    """The correction of one NC program."""

    name: str
    largest_um: float
    """Largest correction on the path."""
    largest_line: int
    """Line in which it occurs; 0 where no move was corrected."""
    blocks_in: int
    """Lines of the program."""
    blocks_out: int
    moves: int
    """Moves of linear axes."""
    corrected: int
    """Moves that were changed."""
    split: int
    """Moves that were written as several blocks."""
    left: int
    """Moves that were left as they are, for the reasons in `warnings`."""
    warnings: tuple[NcWarning, ...]
    assumptions: tuple[str, ...]

    def text(self) -> str:
        """Summary in a few lines."""
        lines = [
            f"{self.name}: {self.corrected} of {counted(self.moves, 'move')} corrected, "
            f"{self.split} of them split; {self.blocks_in} lines in, {self.blocks_out} out",
        ]
        if self.largest_line:
            where = f"line {self.largest_line}"
            lines.append(f"largest correction {self.largest_um:.2f} um in {where}")
        if self.left:
            lines.append(f"{counted(self.left, 'move')} left without a correction:")
        lines += [f"  {warning}" for warning in self.warnings]
        lines += [f"assumed: {text}" for text in self.assumptions]
        return "\n".join(printable(line, lines=False) for line in lines)


def warnings_of(causes: list[Cause]) -> tuple[NcWarning, ...]:
    """One warning per reason, in the order of the program."""
    by_text: dict[str, list[Cause]] = {}
    for cause in causes:
        if cause.moves or cause.always:
            by_text.setdefault(cause.text, []).append(cause)
    return tuple(
        NcWarning(
            tuple(cause.line for cause in same[:5]),
            text + (f" ({len(same)} times)" if len(same) > 5 else ""),
            sum(cause.moves for cause in same),
            max(cause.last for cause in same),
        )
        for text, same in by_text.items()
    )
