"""Three hundred impossible declarations: nearly all of them are refused, in one message."""

import csv
import itertools

import numpy as np
import pytest

from impossible import ACCEPTED, COLUMNS, declarations
from vcal.demo import STARTS
from vcal.errors import StudyError
from vcal.study import load_study

DECLARATIONS = list(declarations())
MOST_ACCEPTED = 5


def refused(folder, overrides=()):
    with pytest.raises(StudyError) as caught:
        load_study(folder, overrides)
    message = str(caught.value)
    assert len(message) <= 1500 and "found" in message and "expected" in message, message
    assert "unknown" not in message, f"refused for its spelling: {message}"


def test_there_are_enough_of_them():
    assert len(DECLARATIONS) + len(COLUMNS) >= 400 and len(ACCEPTED) <= MOST_ACCEPTED
    assert all(len(why) > 20 for why in ACCEPTED.values())
    assert len({*DECLARATIONS}) == len(DECLARATIONS)


@pytest.mark.parametrize(("kind", "declared"), DECLARATIONS)
def test_a_declaration(kind, declared):
    if declared in ACCEPTED:
        load_study(STARTS / kind, declared.split(" & "))
    else:
        refused(STARTS / kind, declared.split(" & "))


def changed(kind, file, column, change, folder):
    """The start study with one column of a table changed."""
    for path in (STARTS / kind).iterdir():
        if path.is_file() and path.name != file:
            (folder / path.name).write_bytes(path.read_bytes())
    with (STARTS / kind / file).open(encoding="utf-8", newline="") as table:
        head, *rows = csv.reader(table)
    if column in head:
        at = head.index(column)
        values = change(np.array([float(row[at]) for row in rows]))
    else:
        at, values = len(head), np.full(len(rows), change)
        head.append(column)
        rows = [[*row, ""] for row in rows]
    for row, value in zip(rows, values, strict=True):
        row[at] = repr(float(value))
    with (folder / file).open("w", encoding="utf-8", newline="") as table:
        csv.writer(table).writerows(itertools.chain([head], rows))


@pytest.mark.parametrize("case", range(len(COLUMNS)), ids=lambda i: "-".join(COLUMNS[i][:3]))
def test_a_column(tmp_path, case):
    kind, file, column, change = COLUMNS[case]
    changed(kind, file, column, change, tmp_path)
    if f"{kind} {column} {case}" in ACCEPTED:
        load_study(tmp_path)
    else:
        refused(tmp_path)
