"""`vcal design` in tests: with little of everything."""

import json
import shutil

import jax
from typer.testing import CliRunner

import vcal
from vcal.cli import app
from vcal.study.design.task import design_task

SMALL = (
    "design.grid=[4,3,3]",
    "design.starts=2",
    "design.steps=8",
)
FREE = ("--set", "design.across_mm=[40,40]", "--set", "design.along=true",
        "--set", "design.spacing_mm=20")  # fmt: skip


def slopes(function, at, way, h=1e-3):
    """The slope of a function along `way`: by its gradient, and by differences of fourth order."""
    value = jax.jit(jax.value_and_grad(lambda step: function(at + step * way)))
    values = {k: float(value(k * h)[0]) for k in (-2, -1, 1, 2)}
    differences = (8.0 * (values[1] - values[-1]) - (values[2] - values[-2])) / (12.0 * h)
    return float(value(0.0)[1]), differences


def declare(folder, tmp_path, text):
    """A copy of a study with more in its study file."""
    copy = tmp_path / "declared"
    shutil.copytree(folder, copy)
    setup = copy / "setup.toml"
    setup.write_text(setup.read_text(encoding="utf-8") + "\n" + text, encoding="utf-8")
    return copy


def run(*arguments, code=0):
    result = CliRunner().invoke(app, [str(a) for a in arguments])
    if result.exception is not None and not isinstance(result.exception, SystemExit):
        raise result.exception
    assert result.exit_code == code, result.output
    return result


def run_trusted(*arguments, code=0):
    """A command that may run the Python files which the study names."""
    return run(*arguments, "--trust", code=code)


def design(setup, out, *options, code=0, small=SMALL):
    sets = [part for text in small for part in ("--set", text)]
    return run("design", setup, "--out", out, *sets, *options, code=code)


def strict(path):
    def refuse(word):
        raise AssertionError(f"{word} is not JSON")

    return json.loads(path.read_text(encoding="utf-8"), parse_constant=refuse)


def task_of(folder, *overrides, small=SMALL):
    study = vcal.load_study(folder, [*small, *overrides])
    return study, design_task(study)
