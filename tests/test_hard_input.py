"""Inputs that no ordinary user makes: not Unicode, not finite, too long, too wide, made anew."""

import hashlib
import json
import os
import subprocess
import sys
import time

import numpy as np
import pytest

from vcal.cli.session import _require_unicode
from vcal.errors import KeyedError, StudyError
from vcal.study import load_study
from vcal.study.messages import listed, refusal, stated
from vcal.study.toml_file import read_setup
from vcal.uncertainty.checkpoint import STATE, Checkpoint
from vcal.uncertainty.outputs import Output
from vcal.uncertainty.streaming import _resume
from vcal.uncertainty.summary import Declared, Summary

LONGEST = 1500
FORMAT = {"campaign": "one"}
ODD = "mine\x1b[2J\u202e"
"""A name that clears the screen and turns the direction of writing."""


def refused(folder, overrides=()):
    with pytest.raises(StudyError) as caught:
        load_study(folder, overrides)
    message = str(caught.value)
    assert len(message) <= LONGEST and message.isprintable() or "\n" in message, message
    return message


@pytest.mark.parametrize("key", ["loop.alpha", "instrument.range_sigma_um", "holdout.share"])
@pytest.mark.parametrize("value", ["nan", "inf", "-inf", "1e999"])
def test_no_number_of_an_override(small_tracker_study, key, value):
    message = refused(small_tracker_study, [f"{key}={value}"])
    assert f"key {key}: found " in message and "expected a finite number" in message


def test_two_overrides_that_are_no_number_are_one(small_tracker_study):
    assert "expected a finite" in refused(small_tracker_study, ["loop.alpha=nan", "loop.alpha=nan"])


@pytest.mark.parametrize("digit", ["²", "٣", "①", "-1", "9" * 5000])
def test_rows_of_an_override_are_numbers_that_python_reads(small_tracker_study, digit):
    setup = small_tracker_study / "setup.toml"
    effect = '\n[[model.effect]]\nname = "backlash"\nplacement = "Y"\nsize_um = 3\n'
    setup.write_text(setup.read_text(encoding="utf-8") + effect, encoding="utf-8")
    message = refused(small_tracker_study, [f"model.effect.{digit}.size_um=3"])
    assert "expected a row from 0 to 0" in message


def test_a_space_that_is_none_of_the_usual_is_seen(small_tracker_study):
    message = refused(small_tracker_study, ["loop.al\u00a0pha=1"])
    assert message.isprintable() and r"al\xa0pha" in message
    assert r"\u2009" in str(refusal("one\u2009file", "key a", "b", "c", "d"))


def test_a_missing_file_is_named_with_its_key(small_ball_study, tmp_path):
    for file, key in (
        ("artefact.csv", "key instrument.artefact of setup.toml"),
        ("errors.csv", "key model.geometric.table of setup.toml"),
        ("data.csv", "key data.data of setup.toml by default"),
    ):
        (small_ball_study / file).rename(tmp_path / file)
        message = refused(small_ball_study)
        assert message.startswith(f"{file}, file: found no such file") and key in message
        (tmp_path / file).rename(small_ball_study / file)


def test_no_path_is_anything_but_unicode():
    odd = os.fsdecode(b"no\xff")
    for arguments in ({"out": odd}, {"setups": ["good", odd]}):
        with pytest.raises(StudyError, match="expected a text in Unicode; rename"):
            _require_unicode(arguments)
    _require_unicode({"out": "größer", "alpha": 0.1, "override": None})


def test_messages_are_cut_and_say_by_how_much():
    names = [f"column_{i:05d}" for i in range(30_000)]
    said = listed(names)
    assert said.endswith("... (29970 more)") and len(said) < 1000
    assert listed(["x" * 5000, "y"]) == f"{'x' * 60}..., y"
    long = refusal("f" * 9000, "w" * 9000, "a" * 9000, "b" * 9000, "do this")
    assert len(str(long)) <= LONGEST and str(long).endswith("; do this")
    assert "more characters" in str(long)
    keyed = KeyedError("instrument.x", "\x1b[31m" + "a" * 9000, "b", "do this")
    message = str(stated("setup.toml", "key x", keyed.what))
    assert len(message) <= LONGEST and "\\x1b" in message and "\x1b" not in message


def test_many_long_mistakes_are_one_message(small_tracker_study):
    more = "".join(f"{'k' * 400}{i} = 1\n" for i in range(50))
    setup = small_tracker_study / "setup.toml"
    setup.write_text(more + setup.read_text(encoding="utf-8"), encoding="utf-8")
    message = refused(small_tracker_study)
    assert "more of the same kind" in message


def test_a_large_study_file_is_not_read(tmp_path):
    path = tmp_path / "setup.toml"
    with path.open("wb") as file:
        file.truncate(8 << 30)  # a sparse file: no disk is used
    with pytest.raises(StudyError, match="found 8192 MB, expected a study file of at most 16 MB"):
        read_setup(path)


def test_control_characters_of_a_table_are_escaped(small_tracker_study):
    data = small_tracker_study / "data.csv"
    rows = data.read_text(encoding="utf-8").splitlines()
    rows = [f"{row},{i if i else ODD}" for i, row in enumerate(rows)]
    data.write_text("\n".join(rows) + "\n", encoding="utf-8")
    study = load_study(small_tracker_study)
    assert "mine\\x1b[2J\\u202e" in study.plan.covariates
    assert all(name.isprintable() for name in study.sets[0].table.header)
    again = load_study(small_tracker_study, {"data.columns": {"load_kg": {"from": ODD}}})
    assert "load_kg" in again.plan.covariates


def test_names_of_stations_are_escaped(small_tracker_study):
    data = small_tracker_study / "data.csv"
    rows = data.read_text(encoding="utf-8").splitlines()
    rows = [f"{r},S{i % 2}\x1b[31m" if i else f"{r},station" for i, r in enumerate(rows)]
    data.write_text("\n".join(rows) + "\n", encoding="utf-8")
    message = refused(small_tracker_study)  # one place for two stations
    assert "S1\\x1b[31m" in message


def wide(folder, columns):
    """Seconds of CPU to read the table of a study with further columns."""
    data = folder / "data.csv"
    rows = data.read_text(encoding="utf-8").splitlines()[:13]
    more = [",".join(f"w{i}" for i in range(columns)), ",".join(["0.5"] * columns)]
    text = "\n".join(f"{r},{more[i > 0]}" for i, r in enumerate(rows)) + "\n"
    (folder / "wide.csv").write_text(text, encoding="utf-8")
    began = time.process_time()
    study = load_study(folder, {"data.data": "wide.csv"})
    assert len(study.plan.covariates) >= columns
    return time.process_time() - began


def test_the_time_to_read_a_wide_table_is_linear(small_tracker_study):
    wide(small_tracker_study, 10)
    few, many = wide(small_tracker_study, 2000), wide(small_tracker_study, 8000)
    assert many < 8.0 * few + 1.0  # four times as many columns; quadratic, it was sixteen times


@pytest.mark.slow
def test_a_full_disk_in_place_of_a_terminal():
    if not os.path.exists("/dev/full"):
        pytest.skip("this system has no /dev/full")
    for arguments in (["effects"], ["--help"], ["--version"]):
        with open("/dev/full", "w") as full:
            run = subprocess.run(
                [sys.executable, "-m", "vcal", *arguments],
                stdout=full, stderr=subprocess.PIPE, text=True, check=False,
            )  # fmt: skip
        assert run.returncode == 2, run.stderr
        assert run.stderr.startswith("vcal: standard output: No space left on device")


# --- checkpoints whose checksums were made anew ---------------------------------------------------


def summary():
    made = Summary(Declared((Output("a"), Output("b", (2,))), (), 10, 0.95, "symmetric", 1000))
    draws = np.random.default_rng(0).normal(size=(64, 3))
    made.add({"a": draws[:, 0], "b": draws[:, 1:]}, 64, 64)
    return made


def signed(folder, change):
    """Change the header of the state, and make its checksum anew."""
    path = folder / STATE
    head, _, rest = path.read_bytes().partition(b"\n")
    header = json.loads(head.partition(b" ")[2])
    change(header)
    line = json.dumps(header).encode()
    path.write_bytes(hashlib.sha256(line).hexdigest().encode() + b" " + line + b"\n" + rest)


FORGED = {
    "a part elsewhere": lambda h: h["parts"].append({"file": "../../x", "sha256": ""}),
    "no arrays": lambda h: h.pop("arrays"),
    "objects": lambda h: h["arrays"][0].__setitem__(1, "|O"),
    "a huge array": lambda h: h["arrays"][0].__setitem__(2, [10**15]),
    "a negative shape": lambda h: h["arrays"][0].__setitem__(2, [-5]),
    "another name": lambda h: h["arrays"][1].__setitem__(0, "moments.other"),
    "no table": lambda h: h.__setitem__("arrays", 3),
    "a shape of text": lambda h: h["arrays"][0].__setitem__(2, "abc"),
    "no fingerprint": lambda h: h.pop("fingerprint"),
    "nothing": lambda h: h.clear(),
    "no parts": lambda h: h.__setitem__("parts", None),
}


@pytest.mark.parametrize("case", FORGED)
def test_a_checkpoint_that_was_signed_anew(tmp_path, case):
    done = summary()
    Checkpoint(tmp_path, FORMAT).save(done.arrays(), done.kept)
    again = summary()
    held = Checkpoint(tmp_path, FORMAT)
    _resume(again, held, 10_000)  # as written
    held.release()
    assert again.draws == done.draws
    signed(tmp_path, FORGED[case])
    with pytest.raises(StudyError, match="expected .*; delete the folder to start again"):
        _resume(summary(), Checkpoint(tmp_path, FORMAT), 10_000)
