"""Laser tracker data as trackers and their programs write them: Cartesian coordinates, another
frame, several stations and tools, ranges alone. Against the independent generator of the oracle.
"""

import numpy as np
import pytest

import vcal
from oracle import as_study, lmmse, make_case, write_study
from oracle.instruments import tracker_points
from oracle.kinematics import euler_xyz, rotation_matrix
from oracle.study import write_csv
from vcal.design.plan_space import Subject
from vcal.design.spaces import SPACES
from vcal.errors import StudyError
from vcal.instruments.base import remarks_of
from vcal.instruments.stations import fitted_pose, laterated
from vcal.loop.weighing.cross_validation import check_rms
from vcal.study.observed_errors import observed_errors
from vcal.study.simulated import write_simulated

SMALL = {"shape": (5, 4, 3), "passes": 2}
POLAR = ("range_mm", "azimuth_rad", "elevation_rad")


@pytest.fixture(scope="module")
def polar(tmp_path_factory):
    """A case with polar readings: the case, its folder and its study."""
    case = make_case("laser_tracker", seed=4, plan=SMALL, n_check=60)
    folder = tmp_path_factory.mktemp("polar")
    write_study(folder, case)
    return case, folder, vcal.load_study(folder)


@pytest.fixture(scope="module")
def ranges(tmp_path_factory):
    """The same for ranges alone from four stations, with three tools."""
    case = make_case("multilateration", seed=1, n_check=100)
    folder = tmp_path_factory.mktemp("ranges")
    write_study(folder, case)
    return case, folder, vcal.load_study(folder)


def rewritten(source, folder, data, change=lambda text: text):
    """A study folder with another table and a changed study file."""
    folder.mkdir()
    for name in ("errors.csv", "check.csv"):
        (folder / name).write_text((source / name).read_text(encoding="utf-8"), encoding="utf-8")
    text = change((source / "setup.toml").read_text(encoding="utf-8"))
    (folder / "setup.toml").write_text(text, encoding="utf-8")
    write_csv(folder / "data.csv", data)
    return folder


def without(text, *keys):
    return "\n".join(line for line in text.split("\n") if not line.startswith(keys))


def coordinates(case, points):
    """The table of a case with coordinates (n, 3), m, in place of its readings."""
    data = {name: values for name, values in case.data.items() if name not in POLAR}
    return data | {f"meas_{c}_mm": 1e3 * points[:, i] for i, c in enumerate("xyz")}


def in_tracker(case):
    """Coordinates in the tracker's own frame (n, 3), m."""
    tracker = case.tracker
    points = tracker_points(tracker, case.readings)
    return (points - tracker.station) @ euler_xyz(tracker.euler)


def rms(study):
    fit = vcal.identify(study.model, study.measurement)
    assert fit.converged
    return check_rms(fit, study.check)[0].value


# --- coordinates ---------------------------------------------------------------------------------


@pytest.mark.thorough
def test_coordinates_are_the_range_and_angles_that_they_came_from(polar, tmp_path):
    case, folder, study = polar
    own = rewritten(folder, tmp_path / "own", coordinates(case, in_tracker(case)))
    again = vcal.load_study(own)
    assert again.instrument.reads == "cartesian"
    apart = again.measurement.readings - study.measurement.readings
    apart[:, 1] -= 2 * np.pi * np.round(apart[:, 1] / (2 * np.pi))
    assert np.abs(apart).max() < 1e-9  # ten digits in the files
    assert rms(again) == pytest.approx(rms(study), rel=1e-3)


@pytest.mark.parametrize("known", ["in the frame", "from station_mm"])
def test_coordinates_in_a_frame_that_was_fitted_elsewhere(polar, tmp_path, known):
    """Any rigid motion of the coordinates: noise counts from the tracker, wherever the frame is."""
    case, folder, study = polar
    turn, shift = rotation_matrix(np.array([0.4, -1.1, 2.3])), np.array([3.0, -2.0, 0.7])
    moved = in_tracker(case) @ turn.T + shift

    def change(text):
        text = text.replace('kind = "laser_tracker"', 'kind = "laser_tracker"\ncoordinates="other"')
        if known == "from station_mm":
            return text
        place = ", ".join(f"{1e3 * v:.6f}" for v in shift)
        return without(text, "station_mm", "euler").replace(
            "angle_sigma", f"station_in_frame_mm = [{place}]\nangle_sigma"
        )

    again = vcal.load_study(rewritten(folder, tmp_path / "other", coordinates(case, moved), change))
    far = again.measurement.readings[:, 0] - study.measurement.readings[:, 0]
    # The declared place is some tenths of a millimetre off the true one.
    assert np.abs(far).max() < (1e-9 if known == "in the frame" else 3e-3)
    assert rms(again) == pytest.approx(rms(study), rel=0.05)


def test_the_place_of_the_tracker_in_another_frame_is_asked_for(polar, tmp_path):
    case, folder, _ = polar
    other = 'kind = "laser_tracker"\ncoordinates = "other"'
    path = rewritten(
        folder,
        tmp_path / "unknown",
        coordinates(case, in_tracker(case)),
        lambda text: without(text, "station_mm").replace('kind = "laser_tracker"', other),
    )
    with pytest.raises(StudyError, match="key instrument.station_in_frame_mm: found nothing for"):
        vcal.load_study(path)


# --- stations ------------------------------------------------------------------------------------


@pytest.mark.parametrize("place", ["[9000, -4000, 100]", ""])
def test_it_starts_from_anywhere(polar, tmp_path, place):
    """A declared place that is metres off is said, and changes nothing; none is needed."""
    case, folder, study = polar

    def change(text):
        text = without(text, "station_mm", "euler")
        return text.replace("angle_sigma", f"station_mm = {place}\nangle_sigma") if place else text

    again = vcal.load_study(rewritten(folder, tmp_path / "far", case.data, change))
    assert rms(again) == pytest.approx(rms(study), rel=1e-3)
    remarks = remarks_of(again.instrument)
    if place:
        (said,) = remarks
        assert "m from instrument.station_mm = [9000, -4000, 100]" in said
        assert np.abs(again.instrument.station - case.tracker.station).max() < 1e-3
    else:
        assert remarks == []
    assert remarks_of(study.instrument) == []


@pytest.mark.thorough
def test_several_stations_in_one_file(polar, tmp_path):
    """A second tracker with another azimuth zero reads half of the points: each has its pose."""
    case, folder, study = polar
    data = {name: values.copy() for name, values in case.data.items()}
    n = len(data["range_mm"])
    second = np.arange(n) % 2 == 1
    data["azimuth_rad"][second] -= 1.3
    data["station"] = np.where(second, "B", "A")
    path = rewritten(
        folder, tmp_path / "two", data, lambda text: without(text, "station_mm", "euler")
    )
    again = vcal.load_study(path)
    assert again.instrument.names == ("A", "B")
    assert [e.key for e in again.model.effects if e.name == "station"] == ["station A", "station B"]
    assert rms(again) == pytest.approx(rms(study), rel=0.3)
    fit = vcal.identify(again.model, again.measurement)
    assert fit.chi2 / fit.dof == pytest.approx(1.0, abs=0.25)
    # Every fold has rows of both stations.
    folds, _ = again.instrument.folds(again.plan)
    assert {(k, s) for k, s in zip(folds, second, strict=True)} == {
        (k, s) for k in range(5) for s in (False, True)
    }
    with pytest.raises(StudyError, match="one place for the 2 stations A, B of column station"):
        vcal.load_study(path, ["instrument.station_mm=[0, 0, 0]"])


# --- tools ---------------------------------------------------------------------------------------


@pytest.mark.thorough
def test_tools_are_a_table_or_a_file(ranges, tmp_path):
    case, folder, study = ranges
    names, offsets = case.stations.tool_names, 1e3 * case.stations.tools
    text = (folder / "setup.toml").read_text(encoding="utf-8")
    start, end = text.index("[instrument.tools]"), text.index("[instrument.stations]")
    without_tools = text[:start] + text[end:]

    def change(_):
        return without_tools.replace('readings = "range"', 'readings = "range"\ntools_file="t.csv"')

    path = rewritten(folder, tmp_path / "file", case.data, change)
    table = {"tool": np.array(names)} | {f"{c}_mm": offsets[:, i] for i, c in enumerate("xyz")}
    write_csv(path / "t.csv", table)
    again = vcal.load_study(path)
    np.testing.assert_allclose(again.instrument.offsets, study.instrument.offsets, atol=1e-12)

    none = rewritten(folder, tmp_path / "none", case.data, lambda _: without_tools)
    with pytest.raises(StudyError, match="key instrument.tools: found no offsets for the 3 tools"):
        vcal.load_study(none)
    wrong = case.data | {"tool": np.where(case.data["tool"] == "T2", "T9", case.data["tool"])}
    other = rewritten(folder, tmp_path / "wrong", wrong)
    with pytest.raises(StudyError, match="column tool: found 'T9', expected one of T1, T2, T3"):
        vcal.load_study(other)


# --- ranges alone --------------------------------------------------------------------------------


@pytest.mark.parametrize("flat", [False, True])
def test_lateration_in_closed_form(flat):
    """Place and dead path from ranges alone, with an outlier; of a plane, on the declared side."""
    rng = np.random.default_rng(3)
    for _ in range(5):
        p = rng.uniform(size=(60, 3)) * [1.0, 0.6, 0.0 if flat else 0.5]
        s, d = np.array([-1.5, 2.0, 1.0]) * rng.choice([-1.0, 1.0], 3), rng.normal()
        read = np.linalg.norm(p - s, axis=1) - d + 1e-7 * rng.normal(size=60)
        read[3] += 0.01
        found = laterated(p, read, near=s + 0.3)
        assert np.abs(found.place - s).max() < 2e-5
        assert found.dead_path == pytest.approx(d, abs=2e-5)
        known = laterated(p, read, near=s + 0.3, dead_path=d)
        assert np.abs(known.place - s).max() < 2e-6


def test_a_pose_in_closed_form_without_outliers():
    rng = np.random.default_rng(5)
    p, turn = rng.uniform(size=(40, 3)), rotation_matrix(np.array([0.3, 2.0, -1.0]))
    seen = (p - [1.0, 2.0, 3.0]) @ turn
    seen[7] += 0.5
    pose = fitted_pose(seen, p)
    assert np.abs(pose.orientation - turn).max() < 1e-12
    assert np.abs(pose.place - [1.0, 2.0, 3.0]).max() < 1e-12


@pytest.mark.slow
def test_multilateration_reaches_the_bound(ranges):
    """Four stations, three tools, 300 points from each: the oracle's own estimate of 21 errors."""
    case, _, study = ranges
    at = study.instrument
    assert np.abs(at.places - case.stations.places).max() < 2e-3
    assert np.abs(at.dead - case.stations.dead_paths).max() < 2e-3
    bound = lmmse(as_study(case))
    assert bound.check_rms_before > 10 * bound.check_rms
    assert rms(study) <= 1.05 * 1e6 * bound.check_rms
    fit = vcal.identify(study.model, study.measurement)
    assert fit.chi2 / fit.dof == pytest.approx(1.0, abs=0.15)


@pytest.mark.thorough
def test_the_rank_is_known_before_measuring(ranges, tmp_path):
    """All 21 errors with three tools; with one on the axis of Z, rolls are not seen at all."""
    case, folder, study = ranges
    found = observed_errors(study.chain, study.instrument, study.plan)
    assert found.complete and len(found.errors) == 21
    assert found.rank == found.columns and "complete" in found.words
    plan = {name: values for name, values in case.data.items() if name != "range_mm"}
    plan["tool"] = np.full(len(plan["tool"]), "T1")
    alone = vcal.load_study(rewritten(folder, tmp_path / "alone", plan))
    assert alone.measurement is None
    less = observed_errors(alone.chain, alone.instrument, alone.plan)
    assert not less.complete
    nothing = {names for names, _ in less.null if len(names) == 1}
    assert nothing == {("ECY",), ("ECZ",)}
    together = [set(names) for names, _ in less.null if len(names) > 1]
    assert {"EXZ", "EBZ"} <= together[0] | together[1]
    assert "nothing of ECY, ECZ" in less.words


def test_one_station_alone_lacks_what_ranges_do_not_show(ranges, tmp_path):
    case, folder, _ = ranges
    here = case.stations.station == 0
    plan = {name: values[here] for name, values in case.data.items() if name != "range_mm"}
    alone = vcal.load_study(rewritten(folder, tmp_path / "one", plan))
    found = observed_errors(alone.chain, alone.instrument, alone.plan)
    assert found.rank < found.columns


def test_ranges_that_do_not_follow_name_the_unit(ranges, tmp_path):
    case, folder, _ = ranges
    inches = case.data | {"range_mm": case.data["range_mm"] / 25.4}
    path = rewritten(folder, tmp_path / "inches", inches)
    with pytest.raises(StudyError, match="they do with inches turned into millimetres in range_mm"):
        vcal.load_study(path)


@pytest.mark.thorough
def test_simulated_ranges_are_read_back(ranges, tmp_path):
    """Stations and tools keep their names, and the result is a study like its model."""
    _, _, study = ranges
    made = write_simulated(study, tmp_path / "sim", seed=3)
    again = vcal.load_study(tmp_path / "sim")
    assert again.instrument.names == study.instrument.names
    apart = again.measurement.readings - made.measurement.readings
    assert np.abs(apart).max() < 1e-9
    fit = vcal.identify(again.model, again.measurement)
    assert fit.chi2 / fit.dof == pytest.approx(1.0, abs=0.15)


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("effect", "key"),
    [
        ({"effect": "jump", "axis": "X", "component": "X", "t0_s": 2000.0, "size_um": 8.0},
         "jump tool"),
        ({"effect": "backlash", "axis": "Y", "size_um": 5.0}, "backlash Y"),
    ],
)  # fmt: skip
def test_the_loop_names_what_is_missing_from_ranges_alone(tmp_path, effect, key):
    """With check points, which belong to no station."""
    case = make_case("multilateration", seed=7, effects=[effect], n_check=60)
    write_study(tmp_path, case)
    study = vcal.load_study(tmp_path)
    found = vcal.close_loop(study.model, study.measurement, check=study.check, draws=100)
    (one,) = found.found
    # A displaced tool is a displaced station: what follows at other stations has their own places.
    assert key in (one.effect.key, *one.equivalent)


def test_design_places_points_and_keeps_stations_and_tools(ranges):
    _, _, study = ranges
    kind = SPACES["laser_tracker"]
    subject = Subject(study.chain, study.instrument, study.plan, "setup.toml")
    space = kind.of(subject, study.model, kind.Settings())
    placed = space.placed(space.start)
    plan = space.plan(placed)
    assert set(space.changed(placed)) == {"stations"}
    np.testing.assert_array_equal(plan.groups["station"], study.plan.groups["station"])
    np.testing.assert_allclose(plan.covariates["range"], study.plan.covariates["range"], atol=2e-3)
    with pytest.raises(StudyError, match="true with 4 stations"):
        low, high = (-500.0, -500.0, 0.0), (0.0, 0.0, 500.0)
        kind.of(
            subject,
            study.model,
            kind.Settings(station=True, station_low_mm=low, station_high_mm=high),
        )


@pytest.mark.thorough
def test_uncertainties_of_multilateration_are_valid(tmp_path):
    """Squareness errors and places of stations within U (k = 2) of 20 simulated measurements."""
    inside = []
    for seed in range(20):
        case = make_case("multilateration", seed=100 + seed, plan={"shape": (4, 4, 3)}, n_check=20)
        write_study(tmp_path / f"{seed}", case)
        study = vcal.load_study(tmp_path / f"{seed}")
        fit = vcal.identify(study.model, study.measurement)
        found = {p.name: (value, u) for _, p, value, u in fit.values_of(0)}
        for name in ("EC0Y", "EB0Z", "EA0Z"):
            value, u = found[name]
            inside.append(abs(value - case.truth["error_motions"][name][0]) <= 2.0 * u)
        assert fit.chi2 / fit.dof == pytest.approx(1.0, abs=0.3)
    assert np.mean(inside) > 0.85
