"""The README of the benchmarks quotes the result files; campaigns resume; summaries repeat."""

import argparse
import json
import re
import sys
from pathlib import Path

import pytest

sys.path.append(str(Path(__file__).parents[1] / "benchmarks"))
import power_summary
import records
import tables


def test_readme_quotes_the_results():
    text = (records.HERE / "README.md").read_text(encoding="utf-8")
    assert tables.renewed(text) == text
    wrong = re.sub(r"\| (\d)(\d*) of \d", r"| 9\1\2 of 9", text, count=1)
    assert wrong != text and tables.renewed(wrong) == text


@pytest.mark.parametrize("name", tables.LONG)
def test_long_tables(name):
    head, _, *rows = tables.made(name).split("\n")
    assert rows and all(row.replace("\\|", "").count("|") == head.count("|") for row in rows)


def test_picture_from_the_summary(tmp_path):
    """The summary alone makes the picture, without the lines of the campaign."""
    found = json.loads((records.RESULTS / "power.json").read_text(encoding="utf-8"))
    power_summary.picture(found, tmp_path / "power.png")
    assert (tmp_path / "power.png").stat().st_size > 50_000


def test_a_campaign_skips_the_sets_that_are_there(tmp_path):
    made = []

    def one_set(case, seed):
        made.append((case, seed))
        return None if case == "c" else {"case": case, "seed": seed}

    jobs = [(case, seed) for seed in range(4) for case in "abc"]

    def run(part, number=2):
        options = argparse.Namespace(
            minutes=1.0, lines=tmp_path / "x.jsonl", jobs=number, part=part
        )
        records.make_sets(options, jobs, ("case", "seed"), one_set)

    run(0)
    first = list(made)
    assert 0 < len(first) < len(jobs)
    run(1)
    assert sorted(made) == sorted(jobs)
    made.clear()
    run(0, number=1)
    assert made == [job for job in jobs if job[0] == "c"]  # a set that cannot be made has no line
    lines = records.known(tmp_path / "x.jsonl")
    assert len(lines) == 8 and sum(records.commits_of(lines).values()) == 8


def test_a_summary_says_what_it_is_of(tmp_path):
    lines, out = tmp_path / "x.jsonl", tmp_path / "x.json"
    options = argparse.Namespace(part=None, summary=True, lines=lines, out=out)

    def summarise():
        records.campaign("x.py", options, lambda _: None, lambda found: {"rows": found})
        return json.loads(out.read_text(encoding="utf-8"))

    with pytest.raises(SystemExit, match="no lines"):
        summarise()
    for seed in (3, 1):
        records.append(lines, {"seed": seed, "commit": "abc"})
    found = summarise()
    assert found["sets"] == 2 and found["seeds"] == [1, 3] and found["commits"] == {"abc": 2}
    records.append(lines, {"seed": 9, "commit": "abd"})
    again = summarise()
    assert again["seeds"] == [1, 9] and again["lines_sha256"] != found["lines_sha256"]
