"""Effects that are declared, or simulated: which have a place, and what is refused."""

import re
from pathlib import Path

import pytest

import vcal
from test_r_test import SETUP, circles, write
from vcal import StudyError
from vcal.demo import starts
from vcal.effects.registry import CATALOGUE
from vcal.loop.screening.candidates import candidates
from vcal.study import load_study, write_table
from vcal.study.simulated import parse_every_with, parse_with, write_simulated
from vcal.study.study import declared_model

STARTS = Path(vcal.__file__).parent / "demo" / "start"
MATRIX = "acceleration_crosstalk", "jerk_crosstalk", "snap_crosstalk"


def declare(*rows):
    return "".join(f"\n[[model.effect]]\n{row}\n" for row in rows)


def append(folder, text):
    with open(folder / "setup.toml", "a", encoding="utf-8") as file:
        file.write(text)


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
    append(made, text)
    return made


@pytest.mark.thorough
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
    assert "key model.effect.0.name (snap_crosstalk): found an effect without a possible" in message
    assert "declare the corrected effect first" in message


@pytest.mark.parametrize("folder", ["one_run", "two_runs"])
@pytest.mark.thorough
def test_what_corrects_an_effect_is_looked_for_beside_it(folder, request, tmp_path):
    folder = request.getfixturevalue(folder)
    study = load_study(with_text(folder, tmp_path, named(MATRIX[0])))
    found, missing = candidates(study.model, study.measurement, study.tried)
    assert set(MATRIX[1:]) <= {e.name for e in found}
    assert not set(MATRIX) & {one.effect for one in missing}


@pytest.mark.thorough
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


@pytest.mark.campaign
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


# --- which one it is -----------------------------------------------------------------------------


def follow(row, told):
    """Do what a message asks for, with the first value that it offers; the message itself where it
    asks for no key.
    """
    match = re.search(r"found \d+ effects .*, expected one, by its (\w+): ([^;]*); add", told)
    if match is None:
        return told
    key, value = match[1], match[2].split(", ")[0]
    assert key not in row
    row[key] = value
    return None


@pytest.mark.parametrize("instrument", starts())
@pytest.mark.slow
def test_a_message_leads_to_one_effect(instrument):
    """Whatever an effect of the catalogue leaves open, its messages can be followed."""
    model, plan = declared_model(STARTS / instrument)
    setup = model.setup(plan)
    followed = 0
    for name, kind in CATALOGUE.items():
        for placement in dict.fromkeys(e.placement for e in kind.candidates(setup)):
            row: dict = {}
            for _ in range(4):
                more = ",".join(f"{key}={value}" for key, value in row.items())
                text = ":".join(filter(None, (name, placement, more)))
                try:
                    parse_with(text, CATALOGUE, setup)
                except StudyError as error:
                    told = follow(row, str(error))
                    # A column that the bundled study lacks is another matter, and so is what the
                    # instrument brings along.
                    if told is not None:
                        known = "an effect that the study or another --with declares"
                        assert "no such column, but" in told or known in told, told
                        break
                    followed += 1
                else:
                    break
            else:
                pytest.fail(f"{text}: no end of it")
    assert followed > 0 or instrument == "laser_frame"


@pytest.mark.parametrize(
    ("text", "key", "expected"),
    [
        ("artefact_bending", "down", "by its down: false, true; add the down"),
        ("artefact_bending:down=maybe", "down", 'found "maybe", expected one of false, true'),
        ("artefact_bending:component=sag_um", "component", "no component; remove the key"),
        ("artefact_bending:dwn=3", "dwn", "expected down, or one of sag_um, sag_down_um"),
        ("artefact_bending:beam=3", "beam", "unknown key 'beam', expected down, or one of sag_um"),
        ("geometric_order:EXX:basis=3", "basis", "unknown key 'basis', expected placement"),
        ("probe_lobing:sizee_um=3", "sizee_um", "expected one of "),
    ],
)
def test_keys_of_a_ball_array(small_ball_study, text, key, expected):
    study = load_study(small_ball_study)
    with pytest.raises(StudyError) as caught:
        parse_with(text, study.catalogue, study.model.setup(study.plan))
    message = str(caught.value)
    assert expected in message
    assert f"key {key} (" in message


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("gear_harmonic:J1", "found 4 effects that these keys fit, expected one, by its order: 1,"),
        ("gear_harmonic:J1:order=9", "key order (gear_harmonic): found 9, expected one of 1, 2, 3"),
        (
            "joint_compliance:J2:torsion=3",
            "found the unknown key 'torsion', expected placement, or ",
        ),
        ("joint_compliance:J2:chain=3", "found the unknown key 'chain', expected placement, or "),
    ],
)
def test_keys_of_an_arm(small_arm_study, text, expected):
    study = load_study(small_arm_study)
    with pytest.raises(StudyError) as caught:
        parse_with(text, study.catalogue, study.model.setup(study.plan))
    assert expected in str(caught.value)


@pytest.mark.parametrize(
    ("text", "down"), [("down=true", True), ("down=false", False), ("sag_down_um=3", True)]
)
def test_a_field_that_is_true_or_false(small_ball_study, text, down):
    study = load_study(small_ball_study)
    place = study.model.setup(study.plan)
    assert parse_with(f"artefact_bending:{text}", study.catalogue, place).down is down
    row = text.replace("=", " = ")
    append(small_ball_study, declare(f'name = "artefact_bending"\n{row}'))
    assert load_study(small_ball_study).model.effects[-1].down is down


def test_an_array_is_no_key_of_a_row(small_tracker_study):
    row = 'name = "geometric_order"\nplacement = "EXX"\nbasis = 3'
    append(small_tracker_study, declare(row))
    with pytest.raises(StudyError, match="effect.0.basis .*found the unknown key 'basis'"):
        load_study(small_tracker_study)


@pytest.mark.thorough
def test_the_bounds_of_joints_are_called_as_they_are(small_arm_study):
    path = small_arm_study / "setup.toml"
    text = path.read_text(encoding="utf-8")
    assert "low_deg" in text
    path.write_text(text.replace("[machine]\n", "[machine]\ntravel_mm = {J1 = [0, 1]}\n"))
    with pytest.raises(StudyError, match="give `low_deg` and `high_deg` .revolute. or `low_mm`"):
        load_study(small_arm_study)
