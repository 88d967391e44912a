"""The laser frame: its geometry against plain numpy, what its beams see, its effects, mistakes."""

import dataclasses

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation as Turn

from known_files import BOX, FRAME, write_frame
from vcal import StudyError, close_loop, load_study, predict
from vcal.effects.geometric import ErrorMotion, GeometricErrors, LocationError
from vcal.effects.laser_frame import FrameExpansion, HeadExpansion, PsdLinearity, Refraction
from vcal.instruments.laser_frame import LaserFrame, beam_path, filter_shift, safe_filter_shift
from vcal.instruments.psd_map import PsdMap
from vcal.loop.outcome.unexplained import Interval, Unexplained
from vcal.machine.chain import chain_from_string
from vcal.machine.error_functions import Legendre
from vcal.machine.plan import Plan
from vcal.model.forward import Model, observe_all
from vcal.plots.views import effect_view
from vcal.report import record
from vcal.report.loop.page import page
from vcal.study import read_table, write_table

TRAVEL = {"X": (0.0, 0.184), "Y": (0.0, 0.167), "Z": (0.0, 0.35)}
THIRTEEN = ("EYX", "EZX", "EXY", "EZY", "EXZ", "EYZ", "EXX", "EYY", "EAX", "EBY")
SQUARE = ("EC0Y", "EB0Z", "EA0Z")


def machine(path="3d", lever=(0.0, 0.0, 0.0), lever_of_psd=0.0, **options):
    """Chain, instrument and plan of the publication's demonstrator."""
    chain = chain_from_string("w b X Y Z t", TRAVEL, lever)
    segments = beam_path(path, TRAVEL)
    instrument = LaserFrame.of(segments, chain, sigma=1e-6, lever=lever_of_psd, **options)
    table = {"segment": np.repeat([s.number for s in segments], [s.points for s in segments])}
    position = np.concatenate([s.positions for s in segments])
    table |= {f"{c}_mm": 1e3 * position[:, i] for i, c in enumerate("xyz")}
    return chain, instrument, instrument.plan(chain, table)


def test_the_paths():
    three, flat = beam_path("3d", TRAVEL), beam_path("planar", TRAVEL)
    for path in (three, flat):
        assert sum(s.points for s in path) == 51
        for one, other in zip(path, path[1:], strict=False):
            assert one.end == other.start  # the beam is one beam
        assert sorted(s.axis for s in path) == ["X", "X", "Y", "Y", "Z"]
    assert len({s.start[2] for s in flat[:4]}) == 1
    with pytest.raises(KeyError):
        beam_path("2d", TRAVEL)


def test_readings_against_plain_numpy():
    """Exact rotations, every port at once: the chain written out by hand."""
    chain, instrument, plan = machine(lever=(0.02, -0.01, -0.15), lever_of_psd=0.0262)
    rng = np.random.default_rng(0)
    ports = 1e-4 * rng.standard_normal((plan.rows, 18 + 6 + len(instrument.ports)))
    args = chain, instrument, plan.position, instrument.rows(plan), ports
    found = np.asarray(observe_all(*args))
    q = np.asarray(plan.position)
    number = np.asarray(plan.groups["segment"])
    way = {s.number: s.direction for s in instrument.segments}
    flat = {s.number for s in instrument.segments if s.psd == "horizontal"}
    for n in range(plan.rows):
        x, y, z, tool, frame = (ports[n, 6 * i : 6 * i + 6] for i in range(5))
        head = ports[n, 30:]
        d = way[number[n]]
        lever = np.zeros(3) if number[n] in flat else -0.0262 * d
        r, t = np.eye(3), np.zeros(3)
        for axis, twist in enumerate((x, y, z)):
            t = t + r @ (q[n, axis] * np.eye(3)[axis] + twist[:3])
            r = r @ Turn.from_rotvec(twist[3:]).as_matrix()
        t = t + r @ (np.array([0.02, -0.01, -0.15]) + tool[:3])
        r = r @ Turn.from_rotvec(tool[3:]).as_matrix()
        p = t + r @ (lever + head[:3])
        nominal = q[n] + [0.02, -0.01, -0.15] + lever
        c = instrument.centre
        moved = Turn.from_rotvec(frame[3:]).as_matrix().T @ (p - c - frame[:3]) - (nominal - c)
        across = np.flatnonzero(np.abs(d) < 0.5)
        np.testing.assert_allclose(found[n], moved[across] + head[3:5], atol=1e-15)


def test_the_filter_against_snell():
    rng = np.random.default_rng(1)
    for _ in range(20):
        u, v = 0.05 * rng.standard_normal(2)
        tangent = np.hypot(u, v)
        inside = np.arcsin(np.sin(np.arctan(tangent)) / 1.52)
        shift = 5e-3 * (tangent - np.tan(inside))
        su, sv = (float(s) for s in filter_shift(u, v, 5e-3, 1.52))
        assert np.hypot(su, sv) == pytest.approx(shift, rel=1e-12)
        assert su / sv == pytest.approx(u / v)
    # The safe side is above: by the share n / (n - 1), about, at small angles.
    exact = float(filter_shift(0.0251, 0.0, 5e-3, 1.5)[0] - filter_shift(0.025, 0.0, 5e-3, 1.5)[0])
    safe = float(safe_filter_shift(0.025, 1e-4, 5e-3))
    assert safe / exact == pytest.approx(3.0, rel=0.01)


def test_the_filter_follows_the_tool():
    chain, plain, plan = machine()
    _, filtered, _ = machine(thickness=5e-3, index=1.5)
    ports = np.zeros((plan.rows, 24 + len(plain.ports)))
    ports[:, 21:24] = 1e-4 * np.random.default_rng(2).standard_normal((plan.rows, 3))
    args = plan.position, plain.rows(plan), ports
    change = np.asarray(observe_all(chain, filtered, *args) - observe_all(chain, plain, *args))
    # At normal incidence: d (1 - 1/n) times the rotation about the other transverse direction.
    w = ports[:, 21:24]
    for s in plain.segments:
        rows = np.asarray(plan.groups["segment"]) == s.number
        turned = np.cross(w[rows], s.direction)[:, list(s.across)]
        np.testing.assert_allclose(change[rows], 5e-3 / 3 * turned, rtol=1e-3, atol=1e-10)


@pytest.mark.parametrize(
    ("path", "lever", "rank"), [("3d", 0.0, 37), ("planar", 0.0, 33), ("3d", 0.0262, 37)]
)
def test_rank_of_the_thirteen(path, lever, rank):
    """As found before, by other code: straightnesses and rolls by Legendre polynomials up to the
    fourth degree, positioning errors by their slope, squarenesses, and the frame's pose.

    The lever of a diode that turns towards the beam costs no rank.
    """
    chain, instrument, plan = machine(path, lever_of_psd=lever)
    degrees = {m: (1, 2, 3, 4) if m[1] in "AB" else (2, 3, 4) for m in THIRTEEN}
    degrees |= {"EXX": (1,), "EYY": (1,)}
    motions = tuple(
        ErrorMotion(m, m[2], Legendre(TRAVEL[m[2]], d, 1e-5)) for m, d in degrees.items()
    )
    square = tuple(LocationError.of(chain, name, 1e-5) for name in SQUARE)
    model = Model(
        chain,
        instrument,
        (GeometricErrors(motions=motions, locations=square), *instrument.effects(plan)),
    )
    size = len(model.entries)
    columns = [
        np.asarray(predict(model, plan, h) - predict(model, plan, -h)).ravel() / 2e-3
        for h in 1e-3 * np.eye(size)
    ]
    j = np.stack(columns, 1)
    assert j.shape == (102, 37)
    sizes = np.linalg.svd(j / np.linalg.norm(j, axis=0), compute_uv=False)
    assert (sizes > 1e-6).sum() == rank


def height_of_a_ray(c, gradient, s):
    """By how much (um) a ray that starts level is above its start after s (m): the ray equation
    d/ds (n dr/ds) = grad n in air whose index falls by c per kelvin.
    """

    def slope(_, state):
        _, z, p, q = state  # the place, and n times the direction
        n = 1.00027 - c * gradient * z
        return p / n, q / n, 0.0, -c * gradient

    ends = solve_ivp(slope, (0.0, s.max()), [0.0, 0.0, 1.00027, 0.0], t_eval=np.unique(s),
                     rtol=1e-10, atol=1e-14).y[1]  # fmt: skip
    return 1e6 * ends[np.unique(s, return_inverse=True)[1]]


def test_effects_reach_the_right_readings():
    chain, instrument, plan = machine()
    s = np.asarray(plan.covariates["path_mm"]) * 1e-3
    assert s.max() == pytest.approx(2 * 0.184 + 2 * 0.167 + 0.35)
    covariates = dict(plan.covariates) | {
        "T_head": np.full(plan.rows, 23.0),
        "T_gradient_z_K_per_m": np.full(plan.rows, 0.7),
        "psd_u_mm": np.linspace(-1.0, 1.0, plan.rows),
    }
    plan = Plan(plan.axes, plan.position, covariates, plan.groups)
    number = np.asarray(plan.groups["segment"])
    level = number != 5
    z = np.asarray(plan.x("Z"))

    def change(effect):
        model = Model(chain, instrument, (effect,))
        size = np.array([1e-6 / p.step * p.si / 1e-6 for p in effect.amplitudes])
        return np.asarray(predict(model, plan, size)) / 1e-6

    head = change(HeadExpansion())
    np.testing.assert_allclose(head[level], np.tile([0.0, -3.0], (level.sum(), 1)), atol=1e-9)
    np.testing.assert_allclose(head[~level], 0.0, atol=1e-9)
    frame = change(FrameExpansion(low=0.0, high=0.35, placement="Z"))
    np.testing.assert_allclose(frame[level, 1], -3.0 * (z[level] / 0.35 - 0.5), atol=1e-9)
    bent = change(Refraction())
    np.testing.assert_allclose(bent[level, 1], -height_of_a_ray(1e-6, 0.7, s[level]), rtol=1e-3)
    np.testing.assert_allclose(bent[level, 1], 0.35 * s[level] ** 2, atol=1e-9)
    np.testing.assert_allclose(bent[~level], 0.0, atol=1e-9)
    x = covariates["psd_u_mm"]
    np.testing.assert_allclose(change(PsdLinearity(placement="u"))[:, 0], x + x**3, atol=1e-9)


def test_map_of_the_diode():
    grid = np.linspace(-1.0, 1.0, 21)
    u, v = np.meshgrid(grid, grid, indexing="ij")
    table = {"u_mm": u.ravel(), "v_mm": v.ravel()}
    table |= {"error_u_um": (2 * u - 3 * v + u * v).ravel(), "error_v_um": (u + v).ravel()}
    found = PsdMap.read("psd.csv", lambda name, columns: table)
    rng = np.random.default_rng(3)
    place = rng.uniform(-1e-3, 1e-3, (50, 2))
    a, b = 1e3 * place.T
    # Bilinear functions are kept by bilinear interpolation.
    exact = np.column_stack([2 * a - 3 * b + a * b, a + b]) * 1e-6
    np.testing.assert_allclose(found(place), exact, atol=1e-15)
    with pytest.raises(StudyError, match="row 2: found the beam at .* misses the diode's range"):
        found(np.array([[0.0, 0.0], [2e-3, 0.0]]))
    gap = {name: values[1:] for name, values in table.items()}
    with pytest.raises(StudyError, match=r"every point once, but \(-1, -1\) mm is there 0 times"):
        PsdMap.read("psd.csv", lambda name, columns: gap)


# --- as a study ----------------------------------------------------------------------------------


@pytest.mark.campaign
def test_a_study_with_a_growing_head(tmp_path):
    study = load_study(write_frame(tmp_path / "study", growth=1.5))
    closure = close_loop(study.model, study.measurement, effects=study.catalogue.values())
    (one,) = closure.effects
    assert one.effect.name == "head_expansion"
    assert one.status == "named"
    ((_, value, _, u),) = one.parameters
    assert value == pytest.approx(1.5, abs=4 * u)


def test_the_map_corrects_the_readings(tmp_path):
    folder = write_frame(tmp_path / "study", growth=0.0)
    plain = load_study(folder).measurement.readings
    rows = len(plain)
    data = (folder / "data.csv").read_text().splitlines()
    head = data[0] + ",psd_u_mm,psd_v_mm"
    data = [head, *(f"{line},0.2,-0.1" for line in data[1:])]
    (folder / "data.csv").write_text("\n".join(data) + "\n")
    lines = ["u_mm,v_mm,error_u_um,error_v_um"]
    lines += [f"{u},{v},{100 * u},{-50 * v}" for u in (-1, 0, 1) for v in (-1, 0, 1)]
    (folder / "psd.csv").write_text("\n".join(lines) + "\n")
    found = load_study(folder, ["instrument.psd_map=psd.csv"]).measurement.readings
    np.testing.assert_allclose(found, plain * [0.9, 1.05], atol=1e-12)
    assert found.shape == (rows, 2)


def test_what_a_diode_shows_is_corrected_to_what_it_was(tmp_path):
    """There and back through a map that no plane fits, with the places on the diode or without."""
    folder = write_frame(tmp_path / "study", growth=0.0)
    study = load_study(folder)
    nodes, rng = np.linspace(-1e-3, 1e-3, 9), np.random.default_rng(6)
    psd_map = PsdMap(nodes, nodes, 20e-6 * rng.standard_normal((9, 9, 2)))
    frame = dataclasses.replace(study.instrument, psd_map=psd_map)
    rows, plan = study.plan.rows, study.plan
    readings = 50e-6 * rng.standard_normal((rows, 2))
    psd = {c: rng.uniform(-0.6, 0.6, rows) for c in ("psd_u_mm", "psd_v_mm")}
    placed = dataclasses.replace(plan, covariates={**plan.covariates, **psd})
    for at in (plan, placed):
        table = frame.to_table(at, readings)
        np.testing.assert_allclose(frame.measured(table), readings, rtol=0, atol=1e-14)
        shown = np.column_stack([table["u_um"], table["v_um"]]) * 1e-6
        assert np.abs(shown - readings).max() > 1e-6
    torn = np.tile(3e-4 * (-1.0) ** np.arange(9)[:, None, None], (1, 9, 2))
    frame = dataclasses.replace(frame, psd_map=dataclasses.replace(psd_map, error=torn))
    with pytest.raises(StudyError, match="psd_map: found readings that still change by"):
        frame.to_table(plan, readings)


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ('"3d"', '"4d"', "'3d', 'planar' or 'own'"),
        (
            '"3d"',
            '"own"',
            "setup.toml, key instrument.beam_path: found 'own' without [[instrument.segment]] rows",
        ),
        (
            'beam_path = "3d"',
            'beam_path = "3d"\n[[instrument.segment]]\nnumber = 1\nstart_mm = [0, 0, 0]\n'
            'direction = "+Y"\nlength_mm = 100',
            "and [[instrument.segment]] rows",
        ),
        (
            'beam_path = "3d"',
            'beam_path = "own"\n[[instrument.segment]]\nnumber = 1\nstart_mm = [0, 0, 0]\n'
            "length_mm = 100",
            "direction",
        ),
        (
            'beam_path = "3d"',
            'beam_path = "own"\n[[instrument.segment]]\nnumber = 1\nstart_mm = [0, 0, 0]\n'
            'direction = "+Y"\nlength_mm = 400\npsd_range_mm = [0, 7]',
            "setup.toml, key instrument.segment.0.psd_range_mm: found [0.0, 7.0], expected",
        ),
        ("sigma_um = 0.5", "sigma_um = -0.5", "sigma_um"),
        ("Z = [0, 350]", "", "setup.toml, key machine.travel_mm: found no travel of every axis"),
    ],
)
def test_mistakes_in_the_study_file(tmp_path, old, new, said):
    folder = write_frame(tmp_path / "study", growth=0.0)
    text = (folder / "setup.toml").read_text()
    assert old in text
    (folder / "setup.toml").write_text(text.replace(old, new))
    with pytest.raises(StudyError) as error:
        load_study(folder)
    assert said in str(error.value)


@pytest.mark.parametrize("factor", [1e-3, 1e-6])
def test_readings_in_millimetres_or_metres(tmp_path, factor):
    """Less than their own noise, whatever the machine does."""
    folder = write_frame(tmp_path / "study", growth=0.0)
    table = read_table(folder / "data.csv", [])
    write_table(folder / "data.csv", dict(table) | {n: factor * table[n] for n in ("u_um", "v_um")})
    said = "data.csv, columns u_um, v_um: found readings with .* expected at least about 0.5"
    with pytest.raises(StudyError, match=said):
        load_study(folder)


@pytest.mark.parametrize(
    ("column", "value", "said"),
    [
        (
            "segment",
            "7",
            "data.csv, row 3 (line 4), column segment: found 7, expected one of 1, 2, 3, 4, 5",
        ),
        ("x_mm", "20", "data.csv, row 3 (line 4): found the position (20, "),
        ("z_mm", "100", "expected one on the beam from"),
        ("u_um", "inf", "column u_um"),
    ],
)
def test_mistakes_in_the_data(tmp_path, column, value, said):
    folder = write_frame(tmp_path / "study", growth=0.0)
    lines = (folder / "data.csv").read_text().splitlines()
    place = lines[0].split(",").index(column)
    row = lines[3].split(",")
    row[place] = value
    lines[3] = ",".join(row)
    (folder / "data.csv").write_text("\n".join(lines) + "\n")
    with pytest.raises(StudyError) as error:
        load_study(folder)
    assert said in str(error.value)


@pytest.mark.parametrize(
    ("wanted", "said"),
    [
        ("{ EYX = 4, EXX = 1, EBY = 4, EC0Y = 0 }", None),
        ("{ EYX = 4, EXX = 3 }", "153 points that identify 10 of 12 parameters; EXX is not"),
        ("{ EYX = 12, EC0Y = 0 }", "EYX, EC0Y are not identified, expected points"),
        ("{ ECZ = 1, EYX = 4 }", "measure more or other positions, or remove errors or degrees"),
        (
            "{ EXYY = 2 }",
            "data.must_see.EXYY: found the unknown error 'EXYY' (did you mean 'EYY'?)",
        ),
        ("{ EYX = 1 }", "data.must_see.EYX: found the degree 1, expected a degree from 2 to 12"),
        ("{ EC0Y = 2 }", "found the degree 2, expected 0, as a location error has no degree"),
        ("{ EYX = true }", "data.must_see.EYX"),
    ],
)
def test_what_the_points_must_see(tmp_path, wanted, said):
    folder = write_frame(tmp_path / "study", growth=0.0)
    text = (folder / "setup.toml").read_text()
    (folder / "setup.toml").write_text(f"{text}\n[data]\nmust_see = {wanted}\n")
    if said is None:
        assert load_study(folder).plan.rows == 153
        return
    with pytest.raises(StudyError) as error:
        load_study(folder)
    assert said in str(error.value)


def test_the_box_is_that_of_the_files():
    assert BOX == (500.0, 400.0, 350.0)
    assert 'kind = "laser_frame"' in FRAME


def warmed(folder):
    """A measurement three degrees warmer throughout, its reference run too."""
    setup = folder / "setup.toml"
    text = setup.read_text()
    setup.write_text(text.replace("sigma_um = 0.5", "sigma_um = 0.5\nreference_degC = 23"))
    path = folder / "data.csv"
    head, *rows = [line.split(",") for line in path.read_text().splitlines()]
    warm = [i for i, name in enumerate(head) if name.endswith("_degC")]
    assert warm
    for row in rows:
        for i in warm:
            row[i] = repr(float(row[i]) + 3.0)
    path.write_text("\n".join(",".join(row) for row in [head, *rows]) + "\n")
    return [head[i] for i in warm]


def test_temperatures_count_from_that_of_the_reference_run(tmp_path):
    """Three degrees more throughout are the same to the errors, and stay as they are in files."""
    cold = load_study(write_frame(tmp_path / "cold", growth=1.5))
    folder = write_frame(tmp_path / "warm", growth=1.5)
    columns = warmed(folder)
    told = load_study(folder)
    excess = told.plan.covariate("T_head") - cold.plan.covariate("T_head")
    np.testing.assert_allclose(excess, 0.0, atol=1e-9)
    table = told.instrument.to_table(told.plan, told.measurement.readings)
    given = read_table(folder / "data.csv", [])
    for name in columns:
        np.testing.assert_allclose(table[name], given[name], atol=1e-9)


@pytest.mark.campaign
def test_reports_show_temperatures_as_the_files_have_them(tmp_path):
    folder = write_frame(tmp_path / "warm", growth=1.5)
    warmed(folder)
    study, given = load_study(folder), read_table(folder / "data.csv", [])["T_head_degC"]
    tried = [study.catalogue[name] for name in ("head_expansion", "frame_expansion")]
    closure = close_loop(study.model, study.measurement, effects=tried, draws=60)
    (one,) = closure.effects
    assert one.effect.name == "head_expansion"
    seen = effect_view(closure.after, one.effect)
    assert "head" in seen.x_label
    assert (seen.x.min(), seen.x.max()) == pytest.approx((given.min(), given.max()))
    where = [Interval("T_head", 19.5, 20.0)]
    what = Unexplained(["T_head"], [0.5], where, "Z", 4.0, 0.5, 1e-4, "so")
    rest = dataclasses.replace(closure, verdict="unexplained", unexplained=what)
    assert rest.sentence.endswith("where T_head_degC is 22.5 to 23.")
    (place,) = record(rest, study)["unexplained"]["where"]
    assert (place["low"], place["high"]) == (22.5, 23.0)
    said = page(rest, study, [], [])
    assert "T_head_degC from 22.50 to 23.00" in said
    assert "Temperatures count from 23 °C." in said
