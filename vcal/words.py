"""Words of messages: plurals, and texts of a user that are safe to print."""

import re
import unicodedata
from collections.abc import Sequence

_UNSEEN = ("Cc", "Cf", "Cs", "Co", "Cn", "Zl", "Zp")
"""Unicode categories of characters that a terminal obeys or that are not seen: control codes,
changes of the direction of writing, separators of lines.
"""


def plural(count: int, one: str, several: str = "") -> str:
    """The noun for a number of things; `several` is its plural where that is not `one` with an s.

    ``plural(1, "row")`` gives ``"row"``, ``plural(0, "row")`` gives ``"rows"``.
    """
    return one if count == 1 else several or f"{one}s"


def counted(count: int, one: str, several: str = "") -> str:
    """A number with its noun: ``"1 reading"``, ``"3 readings"``."""
    return f"{count} {plural(count, one, several)}"


def three_digits(value: float) -> str:
    """A number of three digits: ``"0.0123"``, ``"4.5"``; larger ones to the unit, ``"1029"``."""
    return f"{value:.0f}" if 999.5 <= abs(value) < 1e6 else f"{value:.3g}"


def some_values(values: Sequence[float], unit: str, most: int = 6) -> str:
    """The first of several values, as alternatives: ``"5.03 or 8.24 mm, or one of 22 others"``."""
    some = f"{' or '.join(f'{value:.4g}' for value in values[:most])} {unit}"
    return f"{some}, or one of {len(values) - most} others" if len(values) > most else some


def printable(text: str, lines: bool = True, *, spaces: bool = True) -> str:
    """A text with control characters written as escapes: ``\\x1b`` for the escape character.

    Ends of lines and tabs are kept with `lines`, as in a text of vcal's own. A text of the user
    that stands in one line is taken without. Without `spaces`, spaces other than the usual one are
    written as escapes too: in a message that quotes a key, they are what is wrong with it.
    """
    if text.isascii() and text.isprintable():
        return text
    kept = "\n\t" if lines else ""
    unseen = _UNSEEN if spaces else (*_UNSEEN, "Zs")
    # A page has a million characters, but few different ones.
    escapes = {
        ord(c): c.encode("unicode_escape").decode()
        for c in set(text)
        if unicodedata.category(c) in unseen and c not in kept and c != " "
    }
    return text.translate(escapes) if escapes else text


def cut(text: str, most: int) -> str:
    """A text of at most about `most` characters; how many were left out of a longer one stands at
    its end, or in its middle where the end matters as much (a list, then what to do).
    """
    if len(text) <= most:
        return text
    tail = most // 4
    return f"{text[: most - tail]}... ({len(text) - most} more characters) ...{text[-tail:]}"


def unsolvable(error: Exception) -> str:
    """Why equations have no solution, without the words of the library that failed to solve them
    ("the 3-th leading minor is not positive definite", "Singular matrix").
    """
    words = str(error)
    if re.search(r"leading minor|singular|positive definite|did not converge", words, re.I):
        return "the readings and the priors do not determine every parameter"
    return words
