"""Lines of an NC program as blocks of words (ISO 6983-1, clause 6; RS-274/NGC, clause 3.3).

A word is a letter and a number; blanks may stand anywhere, also inside a number. The place of every
word in the line is kept, so that a word can be replaced and the rest stays byte for byte.
"""

import re
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import NamedTuple

_LINE = re.compile(r"([^\r\n]*)(\r\n|\n|\r|\Z)")
_TOKEN = re.compile(
    r"(?P<letter>[A-Za-z$])[ \t]*"
    r"(?P<number>[+-]?[ \t]*(?:\d[\d \t]*(?:\.[\d \t]*)?|\.[ \t]*\d[\d \t]*))"
    r"|(?P<comment>\([^)]*\)|;.*)"
)
"""The letter may be `$`, the number of a spindle in LinuxCNC."""
_START = re.compile(r"(?P<bom>\xef\xbb\xbf)?[ \t]*(?P<slash>/\d?)?")
_FLOW = re.compile(
    r"[ \t]*/?[ \t]*(?:n[\d \t]+)?"
    r"o[ \t]*(?P<label>\d+|<[^>]*>|#\S+|\[[^\]]*\])[ \t]*(?P<word>[a-z]*)",
    re.I,
)
_MACRO = re.compile(
    r"(?:IF|WHILE|GOTO|THEN|ELSE|DO|END|WHEN|POPEN|PCLOS|DPRNT|BPRNT)(?![a-z])", re.I
)
_VALUE = re.compile(r"(?P<letter>[A-Za-z@^])[ \t]*[+-]?[ \t]*(?=[#\[])")
_ASSIGNED = re.compile(r"#[ \t]*(?:\d+|<[^>]*>|\[[^=]*\])[ \t]*=")
_OFFSETS = re.compile(r"#[ \t]*(?:5[23]\d\d|\[|25\d\d|7\d\d\d|1[23]\d\d\d)")
"""Parameters that hold work offsets, local offsets and tool lengths, or may hold them."""


class Word(NamedTuple):
    """A letter with its number, and the place of both in the line."""

    letter: str
    """In upper case."""
    value: float | None
    """None where it is a variable or an expression."""
    start: int
    end: int


@dataclass(slots=True)
class Block:
    """A line of a program."""

    line: int
    """From 1."""
    text: str
    """Without its end."""
    eol: str
    words: list[Word] = field(default_factory=list)
    deleted: bool = False
    """Whether it begins with a slash (block delete)."""
    kind: str = "words"
    """`words`, `percent`, `flow` (an O-word of LinuxCNC), `macro` (IF, WHILE or GOTO of custom
    macros), `assignment` (of variables), `offsets` (assignment of a work offset), or `unreadable`.
    """
    flow: tuple[str, str] = ("", "")
    """Label and keyword of an O-word."""
    found: str = ""
    """What could not be read."""
    polar: bool = False
    """Whether it has the polar words `@` and `^` of LinuxCNC."""


def lines(text: str) -> Iterator[tuple[int, str, str]]:
    """Number, text and end of every line; CR, LF and CR LF end a line."""
    size, at, number = len(text), 0, 0
    while at < size:
        found = _LINE.match(text, at)
        assert found is not None
        number += 1
        yield number, found[1], found[2]
        at = found.end()


def read_block(line: int, text: str, eol: str) -> Block:
    """The block of a line. What it means is decided later; nothing is raised here."""
    block = Block(line, text, eol)
    at = 0
    if not "A" <= text[:1] <= "z":  # blanks, a slash or a byte order mark
        start = _START.match(text)
        assert start is not None
        block.deleted = start["slash"] is not None
        at = start.end()
    if text.startswith("%", at):
        block.kind = "percent"
        return block
    words = block.words
    for found in _TOKEN.finditer(text, at):
        begin, end = found.span()
        if begin != at and text[at:begin].strip(" \t"):
            return _special(block, at)
        at = end
        letter, number = found.group(1, 2)
        if number is not None:
            if number[-1] in " \t":
                at -= len(number) - len(number.rstrip(" \t"))
            try:
                value = float(number)
            except ValueError:
                value = float(number.replace(" ", "").replace("\t", ""))
            words.append(Word(letter.upper(), value, begin, at))
    if at != len(text) and text[at:].strip(" \t\x00\x1a"):
        return _special(block, at)
    if words and words[0].letter in "NO" and any(w.letter == "O" for w in words[:2]):
        return _numbered(block)
    return block


def _numbered(block: Block) -> Block:
    """A program number such as O1234 is no word of control flow and moves nothing."""
    flow = _FLOW.match(block.text)
    if flow is not None and flow["word"]:
        block.kind, block.flow = "flow", _label(flow)
    block.words = [w for w in block.words if w.letter not in "NO"]
    return block


def _label(flow: re.Match[str]) -> tuple[str, str]:
    """Label and keyword; both may be in any case, the label with blanks."""
    return "".join(flow["label"].split()).lower(), flow["word"].lower()


def _special(block: Block, at: int) -> Block:
    """A block that is more than letters and numbers: O-words, variables, macros, polar words."""
    text = block.text
    block.words = []
    flow = _FLOW.match(text)
    if flow is not None:
        block.kind, block.flow = "flow", _label(flow)
        return block
    code = re.sub(r"\([^)]*\)", lambda m: " " * len(m[0]), text).split(";")[0]
    if open_comment := re.search(r"[()]", code):
        block.kind, block.found = "unreadable", code[open_comment.start() :].strip()
    elif _MACRO.search(re.sub(r"\[.*\]|<[^>]*>", "", code)):
        block.kind = "macro"
    elif _ASSIGNED.search(code):
        plain = re.sub(r"^[ \t]*/?[ \t]*(?:[nN][\d \t]+)?", "", code).lstrip()
        block.kind = "assignment" if plain.startswith("#") else "macro"
        if any(_OFFSETS.match(m[0]) for m in _ASSIGNED.finditer(code)):
            block.kind = "offsets"
    else:
        _with_expressions(block, code)
    if block.kind == "unreadable":
        block.found = block.found or text[at:].strip()
    return block


def _with_expressions(block: Block, code: str) -> None:
    """Words of which some have a variable or an expression as their value."""
    start = _START.match(code)
    assert start is not None
    at = start.end()
    while at < len(code):
        if code[at] in " \t\x00\x1a":
            at += 1
            continue
        if found := _TOKEN.match(code, at):
            end = at + len(found[0].rstrip())
            number = "".join(found["number"].split())
            block.words.append(Word(found["letter"].upper(), float(number), at, end))
        elif found := _VALUE.match(code, at):
            end = _end_of_expression(code, found.end())
            block.words.append(Word(found["letter"].upper(), None, at, end))
        elif code[at] in "@^" and (found := _TOKEN.match("A" + code[at + 1 :])):
            end = at + len(found[0])
        else:
            block.kind, block.found = "unreadable", code[at:].strip()
            return
        block.polar |= code[at] in "@^"
        at = end


def _end_of_expression(code: str, at: int) -> int:
    """Where `#5`, `#<name>`, `#[...]` or `[...]` ends that begins at `at`."""
    while at < len(code) and code[at] in "# \t":
        at += 1
    if at < len(code) and code[at] == "[":
        depth = 0
        for i in range(at, len(code)):
            depth += (code[i] == "[") - (code[i] == "]")
            if depth == 0:
                return i + 1
        return len(code)
    found = re.compile(r"<[^>]*>|[\d.]+").match(code, at)
    return found.end() if found else at + 1
