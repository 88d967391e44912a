"""Effects that are declared, or simulated: which have a place, and what is refused."""

import pytest

import vcal
from test_r_test import SETUP, circles, write
from vcal import StudyError
from vcal.io import load_study, write_table
from vcal.io.simulated import parse_every_with, write_simulated
from vcal.loop.candidates import candidates

MATRIX = "acceleration_crosstalk", "jerk_crosstalk", "snap_crosstalk"


def declare(*rows):
    return "".join(f"\n[[model.effect]]\n{row}\n" for row in rows)


def named(*names):
    return declare(*(f'name = "{name}"' for name in names))


# --- effects that are there beside another -------------------------------------------------------


@pytest.fixture(scope="module")
def one_run(tmp_path_factory):
    return write(tmp_path_factory.mktemp("declared") / "one", circles(samples=40))


@pytest.fixture(scope="module")
def two_runs(tmp_path_factory):
    """Two R-tests of one machine; their runs have the same numbers."""
    folder = tmp_path_factory.mktemp("declared")
    text = ""
    for seed, name in enumerate(("first", "second")):
        write_table(folder / f"{name}.csv", circles(samples=40, seed=seed))
        instrument = SETUP.replace("[instrument]", "[data.instrument]")
        text += f'\n[[data]]\nname = "{name}"\nfile = "{name}.csv"\n{instrument}'
    (folder / "setup.toml").write_text(text, encoding="utf-8")
    return folder


def with_text(folder, tmp_path, text):
    """The study with more text in its setup.toml."""
    made = tmp_path / "more"
    made.mkdir()
    for file in folder.iterdir():
        (made / file.name).write_bytes(file.read_bytes())
    with open(made / "setup.toml", "a", encoding="utf-8") as file:
        file.write(text)
    return made


@pytest.mark.parametrize("folder", ["one_run", "two_runs"])
def test_what_corrects_an_effect_is_declared_below_it(folder, request, tmp_path):
    folder = request.getfixturevalue(folder)
    study = load_study(with_text(folder, tmp_path, named(*MATRIX)))
    assert [e.name for e in study.model.effects if e.name in MATRIX] == [*MATRIX]
    fit = vcal.identify(study.model, study.measurement)
    assert fit.chi2 / fit.dof == pytest.approx(1.0, abs=0.1)


def test_what_corrects_an_effect_that_is_not_declared(one_run, tmp_path):
    with pytest.raises(StudyError) as caught:
        load_study(with_text(one_run, tmp_path, named(*reversed(MATRIX))))
    message = str(caught.value)
    assert "key model.effect.0.name (snap_crosstalk): found an effect that has no place" in message
    assert "declare that effect first" in message


@pytest.mark.parametrize("folder", ["one_run", "two_runs"])
def test_what_corrects_an_effect_is_looked_for_beside_it(folder, request, tmp_path):
    folder = request.getfixturevalue(folder)
    study = load_study(with_text(folder, tmp_path, named(MATRIX[0])))
    found, missing = candidates(study.model, study.measurement, study.tried)
    assert set(MATRIX[1:]) <= {e.name for e in found}
    assert not set(MATRIX) & {one.effect for one in missing}


def test_circles_are_told_apart_by_their_data_set(two_runs, tmp_path):
    """Runs of one number in two data sets are two circles, of paces of their own."""
    (slow, fast), both = (
        (circles(samples=40, levels=levels) for levels in ((0.5, 1.0), (2.0, 4.5))),
        with_text(two_runs, tmp_path, named(*MATRIX)),
    )
    for name, table in (("first", slow), ("second", fast)):
        write_table(both / f"{name}.csv", table)
    study = load_study(both)
    (jerk,) = (e for e in study.model.effects if e.name == "jerk_crosstalk")
    whole = jerk.response(study.plan, {})
    for one in study.sets:
        rows, alone = study.plan.in_set(one.name), type(jerk)(axes=jerk.axes)
        for key, column in alone.response(one.plan, {}).items():
            assert whole[key][rows] == pytest.approx(column)


@pytest.mark.parametrize("folder", ["one_run", "two_runs"])
def test_what_corrects_an_effect_is_simulated_after_it(folder, request, tmp_path):
    folder = request.getfixturevalue(folder)
    study = load_study(folder)
    place = study.model.setup(study.plan)
    effects = parse_every_with(MATRIX, study.catalogue, place, study.files)
    assert [e.name for e in effects] == [*MATRIX]
    write_simulated(study, tmp_path / "made", effects=effects)
    assert load_study(tmp_path / "made").measurement.rows == study.plan.rows
    with pytest.raises(StudyError, match="jerk_crosstalk.*no place here"):
        parse_every_with(MATRIX[1:], study.catalogue, place, study.files)
