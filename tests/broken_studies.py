"""Broken studies by the thousand: mutations of the start studies, with a structure."""

import csv
import io
import math
import string
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path

import tomli_w
from hypothesis import strategies as st

from vcal.demo import STARTS
from vcal.errors import StudyError
from vcal.study import load_study
from vcal.study.toml_file import read_setup

KINDS = sorted(path.name for path in STARTS.iterdir() if (path / "setup.toml").is_file())
LONGEST = 1500

NUMBERS = st.one_of(
    st.sampled_from(
        [0, -1, 1, 1e-300, 1e300, -1e15, 1e-9, 0.1, 1000, 2**63 - 1, -(2**63) + 1, 1e6, math.pi]
    ),
    st.floats(allow_nan=False, allow_infinity=False),
    st.integers(-(2**63) + 1, 2**63 - 1),
)
TEXTS = st.one_of(
    st.sampled_from(
        ["", "data.csv", "X", "=1+1", "<script>", "\x1b[2J", "\u202e", "nan", "../x", "/dev/zero"]
    ),
    st.text(max_size=30),
    st.text(string.ascii_letters + string.digits + "_.", min_size=1, max_size=2000),
)
VALUES = st.recursive(
    st.one_of(NUMBERS, TEXTS, st.booleans()),
    lambda inner: st.one_of(
        st.lists(inner, max_size=4),
        st.dictionaries(st.text(string.ascii_lowercase + "_", max_size=12), inner, max_size=3),
    ),
    max_leaves=8,
)
CELLS = st.one_of(
    st.sampled_from(
        [
            "",
            "nan",
            "inf",
            "-inf",
            "1e400",
            "0x10",
            "1,5",
            "1.234.567",
            "=A1",
            "\x00",
            "é",
            "٣",
            "²",
            "-",
            "--5",
            "1e-400",
            "9" * 400,
            '"',
            "'",
            "true",
            "2026-01-01",
            "\x1b[31m",
            "<b>",
        ]
    ),  # fmt: skip
    NUMBERS.map(repr),
    st.text(max_size=12),
)
CHANGES_OF_KEYS = st.sampled_from(["value", "value", "value", "drop", "rename", "double", "scale"])
CHANGES_OF_TABLES = st.sampled_from(
    [
        "cell",
        "cell",
        "cell",
        "row",
        "column",
        "swap",
        "cut",
        "repeat",
        "scale",
        "separator",
        "bytes",
    ]
)


@dataclass
class Outcome:
    """What has become of the inputs."""

    counts: Counter = field(default_factory=Counter)
    """Refused, accepted; by kind of the study."""
    accepted: list[Path] = field(default_factory=list)


def leaves(tree, key=()):
    """Key paths of all values of a tree."""
    if isinstance(tree, dict):
        for name, inner in tree.items():
            yield (*key, name)
            yield from leaves(inner, (*key, name))
    elif isinstance(tree, list):
        for i, inner in enumerate(tree):
            yield (*key, i)
            yield from leaves(inner, (*key, i))


def mutated_setup(draw, tree):
    """The tree of a study file with one value changed."""
    *way, last = draw(st.sampled_from(sorted(leaves(tree), key=repr)))
    table = tree
    for part in way:
        table = table[part]
    change, value = draw(CHANGES_OF_KEYS), table[last]
    if change == "drop":
        del table[last]
    elif change == "rename" and isinstance(table, dict):
        table[draw(TEXTS)] = table.pop(last)
    elif change == "double" and isinstance(table, list):
        table.append(value)
    elif change == "scale" and isinstance(value, int | float):
        table[last] = float(value) * draw(st.sampled_from([-1.0, 1e-3, 1e3, 25.4, 1e6, 0.0]))
    else:
        table[last] = draw(VALUES)


def mutated_table(draw, text):
    """A CSV table with one change, as bytes."""
    rows = [*csv.reader(io.StringIO(text))]
    row = draw(st.integers(0, len(rows) - 1))
    place = draw(st.integers(0, len(rows[0]) - 1))
    change = draw(CHANGES_OF_TABLES)
    if change == "cell":
        rows[row][place] = draw(CELLS)
    elif change == "row":
        del rows[row]
    elif change == "column":
        rows = [r[:place] + r[place + 1 :] for r in rows]
    elif change == "swap":
        other = draw(st.integers(0, len(rows[0]) - 1))
        for r in rows[draw(st.integers(0, 1)) :]:
            r[place], r[other] = r[other], r[place]
    elif change == "cut":
        rows = rows[: draw(st.integers(0, 4))]
    elif change == "repeat":
        rows.append(rows[row])
    elif change == "scale":
        factor = draw(st.sampled_from([-1.0, 0.0, 1e-3, 1e3, 25.4, 57.29577951308232]))
        for r in rows[1:]:
            try:
                r[place] = repr(float(r[place]) * factor)
            except ValueError:
                break
    written = io.StringIO()
    csv.writer(written, lineterminator="\n").writerows(rows)
    found = written.getvalue()
    if change == "separator":
        found = found.replace(",", draw(st.sampled_from([";", "\t", "|", " ", ", "])))
    data = found.encode("utf-8", "surrogatepass")
    if change == "bytes":
        at = draw(st.integers(0, len(data)))
        data = data[:at] + draw(st.binary(max_size=20)) + data[at + draw(st.integers(0, 20)) :]
    return data


@st.composite
def studies(draw):
    """The files of a broken study by name, and the start study from which it was made."""
    kind = draw(st.sampled_from(KINDS))
    files = {path.name: path.read_bytes() for path in (STARTS / kind).iterdir() if path.is_file()}
    tables = sorted(name for name in files if name.endswith(".csv"))
    for _ in range(draw(st.integers(1, 3))):
        if draw(st.booleans()):
            tree, _ = read_setup(STARTS / kind / "setup.toml")
            mutated_setup(draw, tree)
            try:
                files["setup.toml"] = tomli_w.dumps(tree).encode()
            except (TypeError, ValueError, OverflowError):
                continue  # no TOML
        elif tables:
            name = draw(st.sampled_from(tables))
            files[name] = mutated_table(draw, (STARTS / kind / name).read_text(encoding="utf-8"))
    return kind, files


def read(folder: Path, kind: str, files, outcome: Outcome):
    """Write the files and read the study: it is read, or refused in one message of the right form.

    Any other exception is that of the caller, whose test fails.
    """
    for old in folder.iterdir():
        old.unlink()
    for name, data in files.items():
        (folder / name).write_bytes(data)
    outcome.counts["inputs"] += 1
    try:
        found = load_study(folder)
    except StudyError as error:
        message = str(error)
        assert 20 < len(message) <= LONGEST, f"{len(message)} characters: {message[:300]}"
        assert all(line.isprintable() for line in message.split("\n")), repr(message[:500])
        assert "found" in message and "expected" in message, message
        outcome.counts["refused"] += 1
        return None
    outcome.counts["accepted"] += 1
    outcome.counts[f"accepted, {kind}"] += 1
    return found
