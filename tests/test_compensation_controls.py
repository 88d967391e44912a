"""Formats of commercial controls: every file is read by a reader of its own.

The readers are written from the public documentation, and move the axes as the control does it.
"""

import re
from dataclasses import replace

import jax
import numpy as np
import pytest
from scipy.interpolate import RegularGridInterpolator

import vcal
from vcal.compensation import verify, working_volume
from vcal.compensation.base import left_over
from vcal.demo import FOLDER
from vcal.machine.chain import chain_from_string
from vcal.model.simulate import simulate

UM = 1e-6
OPTIONS = {
    "siemens-840d": {"points": 9},
    "beckhoff-tf5280": {"points": 6},
    "heidenhain": {"points": 9},
    "fanuc": {"unit_um": 0.1, "magnification": 10, "reference_mm": "800,500,0", "interval_mm": 25},
    "klipper": {},
}


@pytest.fixture(scope="module")
def machine():
    """A machine with backlash in Y, measured."""
    study = vcal.load_study(FOLDER / "setup.toml")
    setup = study.model.setup(study.plan)
    backlash = next(e for e in vcal.CATALOGUE["backlash"].candidates(setup) if e.placement == "Y")
    made = simulate(study.model, study.plan, jax.random.key(3), effects=(backlash,))
    fit = vcal.identify(made.model, made.measurement)
    return vcal.IdentifiedMachine.of_fit(fit, name="the machine", date="2026-01-31")


@pytest.fixture(scope="module")
def built(machine):
    return {name: vcal.compensate(machine, name, OPTIONS[name]) for name in OPTIONS}


@pytest.fixture(scope="module")
def use(machine):
    """Positions between the nodes, at random."""
    found = working_volume(machine, 6)
    low, high = machine.volume.T
    random = np.random.default_rng(2)
    return replace(found, position=random.uniform(low, high, found.position.shape))


def applied(compensation, use):
    return compensation.applied(use.position, use.directions, use.covariates)


def rms_um(machine, tables, use):
    return 1e6 * np.sqrt((left_over(machine, tables, use) ** 2).sum(1).mean())


# --- all -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", OPTIONS)
@pytest.mark.thorough
def test_rotary_axes_are_refused(machine, name):
    chain = chain_from_string(
        "w C b X Y Z t", {"X": (0, 0.5), "Y": (0, 0.5), "Z": (0, 0.5)}, rotary_m={"C": (0, 0, 0)}
    )
    more = replace(machine, chain=chain, volume=np.vstack([machine.volume, [0.0, 6.0]]), check=None)
    with pytest.raises(vcal.StudyError, match=r"(?s)format .*: found .* C, expected"):
        vcal.compensate(more, name)


@pytest.mark.parametrize("name", OPTIONS)
@pytest.mark.thorough
def test_the_expected_error_becomes_smaller(machine, built, name):
    """After alignment: a format may shift the zero of the machine."""
    before, after = (
        verify(machine, tables, points=4, draws=20).aligned["working volume"].rms.mean
        for tables in (None, built[name].tables)
    )
    assert after < before


@pytest.mark.parametrize("name", OPTIONS)
def test_what_stays_has_a_reason(built, name):
    assert built[name].not_carried
    for part in built[name].not_carried:
        assert part.reason, part.name


@pytest.mark.parametrize("name", OPTIONS)
def test_an_axis_without_travel_is_refused(machine, name):
    volume = machine.volume.copy()
    volume[1, 1] = volume[1, 0]
    with pytest.raises(vcal.StudyError, match=r"found no travel of Y, expected two"):
        vcal.compensate(replace(machine, volume=volume), name)


# --- SINUMERIK -----------------------------------------------------------------------------------


class Sinumerik:
    """Reads the system variables of K3 and moves the axes, mm."""

    def __init__(self, files, names=("X1", "Y1", "Z1")):
        self.names, self.set = names, {}
        for name in ("AX_EEC.INI", "NC_CEC.INI"):
            lines = [line for line in files[name].splitlines() if line[0] != ";"]
            assert lines[0] == "%_N_" + name.replace(".", "_")
            assert lines[1] == "CHANDATA(1)" and lines[-1] == "M17"
            for line in lines[2:-1]:
                found = re.fullmatch(r"\$(A[AN]_\w+)\[([^\]]+)\]=(.+)", line)
                self.set[found[1], *found[2].split(",")] = found[3]

    def value(self, prefix, index, x):
        low, high, step = (float(self.set[f"{prefix}_{k}", *index]) for k in ("MIN", "MAX", "STEP"))
        points = round((high - low) / step) + 1
        assert low + (points - 1) * step == pytest.approx(high, abs=1e-6)
        assert self.set[f"{prefix}_IS_MODULO", *index] == "0"
        if prefix == "AN_CEC":
            values = [float(self.set[prefix, *index, str(n)]) for n in range(points)]
        else:
            values = [float(self.set[prefix, "0", str(n), index[1]]) for n in range(points)]
        return np.interp(x, low + step * np.arange(points), values)

    def encoders(self, position, directions):
        setpoint = position.copy()
        tables = [key[1] for key in self.set if key[0] == "AN_CEC_INPUT_AXIS"]
        times = {t: int(self.set["AN_CEC_MULT_BY_TABLE", t]) for t in tables}
        factors = {str(n - 1) for n in times.values() if n}
        for t in set(tables) - factors:
            value = self.cec(t, position)
            if times[t]:
                value = value * self.cec(str(times[t] - 1), position)
            way = int(self.set["AN_CEC_DIRECTION", t])
            if way:
                value = np.where(directions[:, self.axis("INPUT", t)] == way, value, 0.0)
            setpoint[:, self.axis("OUTPUT", t)] += value
        encoder = setpoint.copy()
        for i, name in enumerate(self.names):
            for _ in range(9):  # the actual position is the encoder with the value added
                encoder[:, i] = setpoint[:, i] - self.value(
                    "AA_ENC_COMP", ("0", name), encoder[:, i]
                )
        return encoder

    def axis(self, which, t):
        return self.names.index(self.set[f"AN_CEC_{which}_AXIS", t].strip("()"))

    def cec(self, t, position):
        return self.value("AN_CEC", (t,), position[:, self.axis("INPUT", t)])


@pytest.mark.parametrize("products", [False, True])
def test_sinumerik(machine, built, use, products):
    found = built["siemens-840d"]
    if products:
        found = vcal.compensate(
            machine, "siemens-840d", {"points": 9, "products": True}, parts=False
        )
    control = Sinumerik(found.files)
    moved = control.encoders(1e3 * use.position, use.directions) - 1e3 * use.position
    np.testing.assert_allclose(1e3 * applied(found, use), moved, atol=1e-7)


def test_sinumerik_carries_what_depends_on_one_position(machine, built, use):
    found = built["siemens-840d"]
    carried = {part.name for part in found.carried}
    assert {"EXX", "EYY", "EZZ", "EYX", "EXY", "EXZ", "EYZ", "backlash Y"} <= carried
    assert not {"EBX", "ECX", "EAY"} & carried
    plain = rms_um(machine, found.tables, use)
    other = vcal.compensate(machine, "siemens-840d", {"points": 9, "products": True}, parts=False)
    assert rms_um(machine, other.tables, use) < 0.2 * plain
    screw = vcal.compensate(machine, "linuxcnc-screw", {"points": 9}, parts=False)
    assert plain < rms_um(machine, screw.tables, use)


def test_sinumerik_backlash(machine, built):
    """Y1 to Y1 has a table for each direction; their difference is minus the backlash."""
    control = Sinumerik(built["siemens-840d"].files)
    ways = {}
    for key, name in control.set.items():
        t = key[1]
        if key[0] == "AN_CEC_INPUT_AXIS" and name == "(Y1)":
            if control.set["AN_CEC_OUTPUT_AXIS", t] == "(Y1)":
                ways[control.set["AN_CEC_DIRECTION", t]] = float(control.set["AN_CEC", t, "4"])
    y = machine.volume[1].mean()
    up, down = (machine.positioning("Y", np.array([y]), d)[0] for d in (1.0, -1.0))
    assert ways["1"] - ways["-1"] == pytest.approx(-1e3 * (up - down), abs=2e-6)


def test_sinumerik_encoder_error_is_subtracted(machine):
    """A positive value moves the axis in the negative direction: it is the positioning error."""
    only = machine.restricted(["EXX"])
    found = vcal.compensate(only, "siemens-840d", {"points": 5}, parts=False)
    x = np.linspace(*machine.volume[0], 5)
    control = Sinumerik({"NC_CEC.INI": "%_N_NC_CEC_INI\nCHANDATA(1)\nM17", **found.files})
    values = control.value("AA_ENC_COMP", ("0", "X1"), 1e3 * x)
    np.testing.assert_allclose(values, 1e3 * only.positioning("X", x, 0.0), atol=2e-6)


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"tables": 2}, r"the machine needs \d+ CEC tables, expected at most the 2"),
        ({"names": "X1,X1,Z1"}, "expected three different names"),
        ({"points": 802}, "option points: found 802"),
    ],
)
def test_sinumerik_options(machine, options, said):
    with pytest.raises(vcal.StudyError, match=said):
        vcal.compensate(machine, "siemens-840d", {"points": 5, **options})


# --- Beckhoff ------------------------------------------------------------------------------------


def isg_csv(text):
    """Columns of a table by their names: arguments in mm, parameters in mm."""
    rows = [line.split() for line in text.splitlines() if line and not line.startswith("//")]
    values = np.array(rows[1:], float)
    return {name: values[:, i] for i, name in enumerate(rows[0])}


def test_beckhoff(machine, built, use):
    found = built["beckhoff-tf5280"]
    table = isg_csv(found.files["volcomp.csv"])
    lines = [np.unique(table[axis]) for axis in "XYZ"]
    shape = [len(line) for line in lines]
    corners = np.stack(np.meshgrid(*lines, indexing="ij"), -1).reshape(-1, 3)
    np.testing.assert_array_equal(corners, np.stack([table[axis] for axis in "XYZ"], 1))
    errors = np.stack(
        [
            RegularGridInterpolator(lines, table[f"E{axis}{axis}"].reshape(shape))(
                1e3 * use.position
            )
            for axis in "XYZ"
        ],
        1,
    )
    np.testing.assert_allclose(1e3 * applied(found, use), -errors, atol=1e-9)


def test_beckhoff_gives_the_error_motion(machine):
    """EXX of a machine with no other error, in every row of the same X."""
    only = machine.restricted(["EXX"])
    found = vcal.compensate(only, "beckhoff-tf5280", {"points": 4}, parts=False)
    table = isg_csv(found.files["volcomp.csv"])
    expected = 1e3 * only.positioning("X", 1e-3 * table["X"], 0.0)
    np.testing.assert_allclose(table["EXX"], expected, atol=2e-6)
    assert not table["EYY"].any() and not table["EZZ"].any()


def test_beckhoff_configuration(built):
    text = built["beckhoff-tf5280"].files["volcomp.lis"]
    keys = dict(line.split() for line in text.splitlines() if line[0] != "#")
    assert keys["file[0]"] == "volcomp.csv" and keys["file_format[0]"] == "ISG_CSV"
    assert keys["interpolation"] == "GRID" and keys["X"] == "1" and keys["workpiece_axes"] == "0"
    assert "max_records of at least 216" in text
    stays = {part.name: part.reason for part in built["beckhoff-tf5280"].not_carried}
    assert "depends on dir_Y" in stays["backlash Y"]


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"points": 13}, "which makes 2197 nodes, expected at most 2000"),
        ({"numbers": "1,1,2"}, "expected three different logical axis numbers"),
    ],
)
def test_beckhoff_options(machine, options, said):
    with pytest.raises(vcal.StudyError, match=said):
        vcal.compensate(machine, "beckhoff-tf5280", options)


# --- HEIDENHAIN ----------------------------------------------------------------------------------


def tnc_table(text):
    """Rows of a table by the names of its columns."""
    lines = text.splitlines()
    assert lines[0].startswith("BEGIN ") and lines[-1] == "[END]"
    rows = [line.split() for line in lines[1:-1]]
    assert [row[0] for row in rows[1:]] == [str(n) for n in range(len(rows) - 1)]
    return [dict(zip(rows[0], row, strict=True)) for row in rows[1:]]


def tnc_moves(files, position, directions):
    """What the control adds, mm: minus the errors of the active row of the assignment table."""
    added = np.zeros_like(position)
    (active,) = [row for row in tnc_table(files["config.cma"]) if row["ACTIVE"] == "*"]
    for j, by in enumerate("XYZ"):
        table = tnc_table(files[active[by]])
        at = [float(row["AXISPOS"]) for row in table]
        for i, corrected in enumerate("XYZ"):
            value = np.interp(position[:, j], at, [float(row[corrected]) for row in table])
            if i == j:
                back = np.interp(position[:, j], at, [float(row["BACKLASH"]) for row in table])
                value = np.where(directions[:, j] < 0, back, value)
            added[:, i] -= value
    return added


def test_heidenhain(built, use):
    found = built["heidenhain"]
    moved = tnc_moves(found.files, 1e3 * use.position, use.directions)
    np.testing.assert_allclose(1e3 * applied(found, use), moved, atol=1e-9)
    carried = {part.name for part in found.carried}
    assert {"EXX", "EYY", "EZZ", "EYX", "EXY", "EXZ", "EYZ", "backlash Y"} <= carried
    assert not {"EBX", "ECX", "EAY"} & carried


@pytest.mark.parametrize(("motion", "by"), [("EXX", "X"), ("EZY", "Y"), ("EYZ", "Z")])
def test_heidenhain_gives_the_error_motion(machine, motion, by):
    """In the column of its direction; of a straightness, up to the mean."""
    only = machine.restricted([motion])
    found = vcal.compensate(only, "heidenhain", {"points": 9}, parts=False)
    table = tnc_table(found.files[f"{by.lower()}.com"])
    values = np.array([float(row[motion[1]]) for row in table])
    (expected,) = [t.value for t in only.error_motions(9) if t.name == motion]
    error = 1e3 * values - expected * only.chain.joint(by).sign
    if motion[1] != by:
        error = 1e3 * values - expected
        error -= error.mean()
    np.testing.assert_allclose(error, 0.0, atol=0.11)


@pytest.mark.parametrize(
    ("options", "said"), [({"points": 257}, "option points: found 257"), ({"rows": 3}, "unknown")]
)
def test_heidenhain_options(machine, options, said):
    with pytest.raises(vcal.StudyError, match=said):
        vcal.compensate(machine, "heidenhain", options)


def test_heidenhain_steep_errors(machine):
    """Errors far above what a table may hold."""
    volume = machine.volume.copy()
    volume[0, 1] = volume[0, 0] + 1e-4
    with pytest.raises(vcal.StudyError, match=r"a change of .* mm between neighbours in"):
        vcal.compensate(
            replace(machine, volume=volume, theta=1e4 * machine.theta), "heidenhain", {"points": 3}
        )


# --- FANUC ---------------------------------------------------------------------------------------


class Pmm:
    """Reads a parameter file, and outputs the pulses of an axis section by section."""

    def __init__(self, text):
        lines = text.split()
        assert lines[0] == lines[-1] == "%"
        self.data, self.axes = {}, {}
        for line in lines[1:-1]:
            number, rest = re.fullmatch(r"N(\d+)(.*);", line).groups()
            if rest[0] == "P":
                self.data[int(number) - 10000] = int(rest[1:])
            for axis, value in re.findall(r"A(\d)P([^A;]+)", rest):
                self.axes[int(number), int(axis)] = float(value)

    def compensation(self, axis, x, way, reference, unit):
        """From the reference to x, mm: every section whose middle is passed adds its value."""
        origin, first, last, times, h, start, back = (
            self.axes[number, axis] for number in (3620, 3621, 3622, 3623, 3624, 3626, 3627)
        )
        shift = 0 if way > 0 else start - first
        total = 0
        for number in range(int(first), int(last) + 1):
            middle = reference + (number - origin - 0.5) * h
            value = self.data[int(number + shift)]
            if number > origin and x >= middle:
                total += value
            if number <= origin and x < middle:
                total -= value
        return unit * (times * total + (back if way < 0 else 0))


def test_fanuc(built, use):
    found = built["fanuc"]
    control = Pmm(found.files["pitch.txt"])
    moved = applied(found, use)
    for row in range(0, len(moved), 5):
        for i, reference in enumerate((800.0, 500.0, 0.0)):
            x, way = 1e3 * use.position[row, i], use.directions[row, i]
            added = control.compensation(i + 1, x, way, reference, 1e-4)
            assert 1e3 * moved[row, i] == pytest.approx(added, abs=1e-9)


def test_fanuc_gives_the_error_motion(machine):
    """EXX at the points, to half a count of each of two rounded values."""
    only = machine.restricted(["EXX"])
    options = {"unit_um": 0.1, "magnification": 5, "interval_mm": 25, "reference_mm": "200,0,0"}
    found = vcal.compensate(only, "fanuc", options, parts=False)
    control = Pmm(found.files["pitch.txt"])
    x = np.linspace(0.0, 0.8, 33)
    values = np.array([control.compensation(1, 1e3 * v, 1, 200.0, 1e-4) for v in x])
    error = only.positioning("X", x, 0.0) - only.positioning("X", np.array([0.2]), 0.0)
    np.testing.assert_allclose(values, -1e3 * error, atol=2.6e-4)


def test_fanuc_numbers_of_the_manual(machine):
    """-400 to 800 mm, interval 50 mm, reference at number 40: sections 33 to 56."""
    volume = machine.volume.copy()
    volume[0] = -0.4, 0.8
    only = replace(machine.restricted([]), volume=volume)
    found = vcal.compensate(only, "fanuc", {"interval_mm": 50}, parts=False)
    control = Pmm(found.files["pitch.txt"])
    origin, first, last = (control.axes[number, 1] for number in (3620, 3621, 3622))
    assert (first - origin, last - origin) == (33 - 40, 56 - 40)


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"interval_mm": 5}, r"which makes 160 points of X, expected at most 128"),
        ({"unit_um": 0.01}, r"a change of \d+ counts between two points of .*magnification \d+"),
        ({"reference_mm": "0"}, "option reference_mm: found '0'"),
    ],
)
def test_fanuc_options(machine, options, said):
    with pytest.raises(vcal.StudyError, match=said):
        vcal.compensate(machine, "fanuc", options)


# --- Klipper -------------------------------------------------------------------------------------


def klipper_moves(text, position):
    """The profile as the firmware reads it, undoing the measured skew x + y xy + z xz, y + z yz."""
    section = text.partition("[skew_correction vcal]\n")[2].splitlines()
    skew = {key: float(value) for key, value in (line.split(": ") for line in section)}
    xy, xz, yz = (skew[f"{plane}_skew"] for plane in ("xy", "xz", "yz"))
    unskew = np.array([[1.0, xy, xz], [0.0, 1.0, yz], [0.0, 0.0, 1.0]])
    return position @ np.linalg.inv(unskew).T


def test_klipper(built, use):
    found = built["klipper"]
    moved = klipper_moves(found.files["skew.cfg"], use.position) - use.position
    np.testing.assert_allclose(applied(found, use), moved, atol=1e-14)


def test_klipper_gives_the_squareness(machine, use):
    """A location error is carried, up to its sign rule and a shift."""
    (name,) = [p.name for p in machine.parts if re.fullmatch("EC0[XY]", p.name)]
    only = machine.restricted([name])
    found = vcal.compensate(only, "klipper", parts=False)
    (angle,) = (1e-6 * t.value[0] for t in only.error_motions(3) if t.name == name)
    xy = float(re.search(r"xy_skew: (.+)", found.files["skew.cfg"])[1])
    assert abs(xy) == pytest.approx(abs(angle), abs=2e-9)
    left = verify(only, found.tables, points=4, draws=2)
    error = left_over(only, found.tables, use)
    assert 1e6 * (error - error.mean(0)).std() < 0.01 and left.raw


@pytest.mark.parametrize(
    ("options", "said"),
    [({"profile": "a b"}, "option profile: found 'a b'"), ({"points": 3}, "unknown option")],
)
def test_klipper_options(machine, options, said):
    with pytest.raises(vcal.StudyError, match=said):
        vcal.compensate(machine, "klipper", options)
