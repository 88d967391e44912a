"""The maths underneath: rotations, families of functions, units, ports, chains."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.polynomial import legendre
from scipy.spatial.transform import Rotation

from oracle import (
    TABLE,
    arm_frames,
    check_plan,
    compose,
    draw_machine,
    example_arm,
    nominal_machine,
    rotation_matrix,
    tool_point,
)
from vcal.effects.geometric import ErrorMotion, GeometricErrors, LocationError, link_errors
from vcal.machine.chain import chain_from_dh, chain_from_string
from vcal.machine.error_functions import Constant, Fourier, Legendre, Matern
from vcal.machine.plan import Plan
from vcal.machine.ports import PortLayout, group
from vcal.model.forward import effect_terms, port_values, tool_points
from vcal.numerics.spatial import (
    align_rigid,
    axis_rotation,
    best_rigid,
    euler_xyz,
    rigid_basis,
    rigid_columns,
    rotation,
    skew,
)
from vcal.units import in_name, si_factor

CHAINS = ["w X b Y Z t", "w b X Y Z t", "w Y b X Z t", "w X Y b Z t", "w Z X Y b t"]
SPANS = {"X": (0.0, 2.0), "Y": (0.0, 1.0), "Z": (-0.1, 0.6)}
TRAVEL = np.array(list(SPANS.values()))
TOOL = (0.01, -0.02, -0.15)
UM = 1e-6
ROWS = 50  # the same everywhere: compiled once per chain


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(20240301)


def points(chain, q, translation=0.0, turned=0.0, tool=0.0):
    """Tool points (n, 3) with error twists (n, axes, 3) and a displacement of the tool (n, 3)."""
    n, axes = q.shape
    twists = np.zeros((n, axes, 6))
    twists[:, :, :3], twists[:, :, 3:] = translation, turned
    ports = np.hstack([twists.reshape(n, -1), np.broadcast_to(tool, (n, 3)), np.zeros((n, 3))])
    return np.asarray(tool_points(chain, q, ports))


# --- rotations -----------------------------------------------------------------------------------


@pytest.mark.parametrize("angle", [0.0, 1e-300, 1e-12, 1e-6, 0.99e-4, 1.01e-4, 1e-3, 0.5, 3.1, 6.0])
def test_rotation_against_scipy(angle, rng):
    for axis in [*np.eye(3), *rng.standard_normal((5, 3))]:
        v = angle * axis / np.linalg.norm(axis)
        expected = Rotation.from_rotvec(v).as_matrix()
        np.testing.assert_allclose(rotation(v), expected, rtol=0, atol=2e-15)


def test_rotation_and_its_derivatives_at_zero():
    zero, generators = jnp.zeros(3), np.stack([np.asarray(skew(e)) for e in np.eye(3)], -1)
    np.testing.assert_array_equal(rotation(zero), np.eye(3))
    for derivative in (jax.jacfwd, jax.jacrev):
        np.testing.assert_allclose(jax.jit(derivative(rotation))(zero), generators, atol=1e-16)
    second = np.asarray(jax.jit(jax.hessian(rotation))(zero))
    product = np.einsum("ijk,jlm->ilkm", generators, generators)
    expected = 0.5 * (product + product.swapaxes(2, 3))
    np.testing.assert_allclose(second, expected, atol=1e-16)


@pytest.mark.parametrize("size", [0.99e-4, 1.01e-4, 0.3])
def test_rotation_derivative_on_both_sides_of_the_series(size):
    v = size * np.array([0.6, -0.64, 0.48])
    step = 1e-5
    ends = [Rotation.from_rotvec(v + sign * step * np.eye(3)).as_matrix() for sign in (1, -1)]
    differences = np.moveaxis(ends[0] - ends[1], 0, -1) / (2 * step)
    slope = jax.jit(jax.jacfwd(rotation))(v)
    np.testing.assert_allclose(slope, differences, atol=1e-9)


def test_euler_angles_are_about_moving_axes(rng):
    for angles in rng.uniform(-2, 2, (5, 3)):
        expected = Rotation.from_euler("XYZ", angles).as_matrix()
        np.testing.assert_allclose(euler_xyz(angles), expected, atol=1e-15)
    for axis, e in zip("xyz", np.eye(3), strict=True):
        np.testing.assert_allclose(axis_rotation(axis, 0.7), rotation(0.7 * e), atol=1e-15)


def test_rigid_motions_are_found_and_taken_out(rng):
    source = rng.uniform(-1, 1, (30, 3))
    r, t = Rotation.from_rotvec([0.3, -1.2, 2.0]).as_matrix(), np.array([3.0, -1.0, 0.5])
    found, origin = best_rigid(source, source @ r.T + t)
    np.testing.assert_allclose(found, r, atol=1e-13)
    np.testing.assert_allclose(origin, t, atol=1e-13)
    # Points in a plane fit their mirror image as well; the answer must be a rotation.
    flat = source * [1.0, 1.0, 0.0]
    assert np.linalg.det(best_rigid(flat, flat @ r.T)[0]) == pytest.approx(1.0)
    small = 1e-5 * rng.standard_normal(6)
    moved = source @ rotation_matrix(small[3:]).T + small[:3] - source
    assert np.abs(align_rigid(source, moved)).max() < 1e-9
    left = align_rigid(source, 1e-5 * rng.standard_normal((30, 3)))
    columns = rigid_columns(source)
    np.testing.assert_allclose(np.einsum("nik,ni->k", columns, left), 0, atol=1e-18)
    np.testing.assert_allclose(columns @ small, moved, atol=1e-9)


@pytest.mark.parametrize("way", [(1.0, 0.0, 0.0), (0.0, -1.0, 0.0), (1.0, 2.0, -0.5)])
def test_a_rigid_motion_of_points_on_a_line(way, rng):
    """A rotation about the line moves nothing: five numbers are taken out, and none is undefined.

    By hand: along the line its mean, across it in either direction a straight line over the place.
    """
    u = np.array(way) / np.linalg.norm(way)
    along = rng.uniform(-1, 1, 20)
    points = np.array([0.3, -0.2, 0.5]) + along[:, None] * u
    assert rigid_basis(points).shape == (60, 5)
    moved = 1e-5 * rng.standard_normal((20, 3))
    lengthwise = moved @ u
    fits = np.polynomial.polynomial.polyfit(along, moved - np.outer(lengthwise, u), 1)
    bent = moved - np.outer(lengthwise, u) - (fits[0] + along[:, None] * fits[1])
    expected = bent + np.outer(lengthwise - lengthwise.mean(), u)
    np.testing.assert_allclose(align_rigid(points, moved), expected, rtol=0, atol=1e-18)
    both = np.stack([moved, 2.0 * moved], -1)
    np.testing.assert_allclose(align_rigid(points, both)[..., 1], 2.0 * expected, atol=1e-18)
    # In one place nothing can be told from a translation.
    np.testing.assert_allclose(
        align_rigid(np.ones((4, 3)), moved[:4]), moved[:4] - moved[:4].mean(0), atol=1e-18
    )


# --- families of functions -----------------------------------------------------------------------


def test_fourier_family_against_numpy():
    harmonics = [(0.5, 20e-6, 0.0), (3.0, 1.5e-6, 2.5e-6)]
    basis = Fourier((-0.2, 1.8), 10e-6, 40e-6, harmonics)
    assert basis.labels == ("a0", "a1", "b1", "b2", "c2")
    np.testing.assert_allclose(basis.sigma * 3**0.5, [10e-6, 40e-6, 20e-6, 1.5e-6, 2.5e-6])
    x = np.linspace(-0.2, 1.8, 41)
    u = np.linspace(-1, 1, 41)
    waves = [np.sin(0.5 * np.pi * u), np.sin(3 * np.pi * u), np.cos(3 * np.pi * u)]
    expected = np.stack([np.ones(41), u, *waves], 1)
    np.testing.assert_allclose(basis.functions(x), expected, atol=1e-14)
    nothing = Fourier((0, 1), 0.0, 0.0, [(0.5, 0.0, 0.0)])
    assert nothing.functions(x).shape == (41, 0)
    np.testing.assert_array_equal(Constant(2e-4).functions(x), np.ones((41, 1)))


@pytest.mark.parametrize("smoothness", [0.2, 0.5, 2.0])
def test_matern_basis_reproduces_its_kernel(smoothness):
    """Covariance sum_k sigma^2 f_k(x) f_k(x') against k(x - x'), off the nodes too."""
    sigma, (low, high) = 7e-6, (-0.5, 1.5)
    basis = Matern((low, high), sigma, smoothness)
    x = np.linspace(low, high, 83)
    values = np.asarray(basis.functions(x)) * basis.sigma
    r = np.sqrt(5) * np.abs(x[:, None] - x) / (smoothness * (high - low))
    kernel = sigma**2 * (1 + r + r**2 / 3) * np.exp(-r)
    np.testing.assert_allclose(values @ values.T / sigma**2, kernel / sigma**2, atol=1e-3)
    assert len(basis.labels) == len(basis.sigma) == values.shape[1] < 40


@pytest.mark.parametrize("degrees", [(0,), (1,), (0, 1, 2, 3), (7, 12)])
def test_legendre_against_numpy(degrees):
    u = np.linspace(-1, 1, 31)
    expected = np.stack([legendre.Legendre.basis(d)(u) for d in degrees], 1)
    basis = Legendre((0.5, 2.5), degrees, 3e-6)
    np.testing.assert_allclose(basis.functions(1.5 + u), expected, atol=1e-13)
    np.testing.assert_array_equal(basis.sigma, np.full(len(degrees), 3e-6))


# --- units and ports -----------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("unit", "factor", "name"),
    [
        ("um", 1e-6, "um"),
        ("urad", 1e-6, "urad"),
        ("um/(m K)", 1e-6, "um_per_m_K"),
        ("urad/K", 1e-6, "urad_per_K"),
        ("um/h", 1e-6 / 3600, "um_per_h"),
        ("urad/m2", 1e-6, "urad_per_m2"),
        ("um/mm2", 1.0, "um_per_mm2"),
        ("mm", 1e-3, "mm"),
        ("deg", np.pi / 180, "deg"),
        ("%", 0.01, "percent"),
        ("1", 1.0, "1"),
        ("1/K", 1.0, "1_per_K"),
        ("degC", 1.0, "degC"),
    ],
)
def test_units(unit, factor, name):
    assert si_factor(unit) == pytest.approx(factor, rel=1e-14)
    assert in_name(unit) == name


@pytest.mark.parametrize(
    ("unit", "found"),
    [("furlong/K", "furlong"), ("10 um", "10"), ("1000", "1000"), ("m2s", "m2s"), ("/K2 h-", "h-")],
)
def test_unknown_unit_is_named(unit, found):
    with pytest.raises(ValueError, match=f"unit '{unit}': found '{found}'"):
        si_factor(unit)


def test_port_layout():
    layout = PortLayout.of(("X", "J2"), group("frame") + ("read.range",))
    assert layout.names[:7] == ("EXX", "EYX", "EZX", "EAX", "EBX", "ECX", "EXJ2")
    assert layout.names[12:18] == tuple(f"tool.{c}" for c in "XYZABC")
    assert len(layout) == 25
    assert "ECJ2" in layout
    assert "ECY" not in layout
    assert layout.index("ECJ2") == 11
    assert layout.slice("frame") == slice(18, 24)
    assert layout.names[layout.slice("read")] == ("read.range",)
    with pytest.raises(ValueError, match="no port named 'EXY'; this model has EXX"):
        layout.index("EXY")
    with pytest.raises(ValueError, match=r"no ports named 'ball'\.\*"):
        layout.slice("ball")


# --- chains of linear axes -----------------------------------------------------------------------


@pytest.mark.parametrize(
    ("text", "tool_side", "workpiece_side"),
    [
        ("w X b Y Z t", "YZ", "X"),
        ("XFYZ", "YZ", "X"),
        ("wXbYZt", "YZ", "X"),
        ("XbYZ", "YZ", "X"),
        ("FXYZ", "XYZ", ""),
        ("w Y X b Z t", "Z", "XY"),
        ("w Z X Y b t", "", "YXZ"),
        ("w b X t", "X", ""),
    ],
)
def test_chain_strings(text, tool_side, workpiece_side):
    """Both sides are ordered from the bed outwards; columns are in the order of the alphabet."""
    chain = chain_from_string(text)
    assert "".join(chain.axes[i] for i in chain.tool_side) == tool_side
    assert "".join(chain.axes[i] for i in chain.workpiece_side) == workpiece_side
    assert list(chain.axes) == sorted(tool_side + workpiece_side)
    assert {joint.sign for joint in chain.joints if joint.name in workpiece_side} <= {-1.0}


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("", "expected 'w'"),
        ("w b t", "expected 'w'"),
        ("w X Y Z t", "expected 'w'"),
        ("w X b Y b Z t", "expected 'w'"),
        ("b X Y Z t", "expected 'w'"),
        ("w X b Y Z", "expected 'w'"),
        ("w X b Y X t", "axis 'X' appears twice"),
        ("w X b C Z t", "the rotary axis 'C' only in the chain"),
        ("w X1 b Y Z t", "axis 'X1' is none of the linear axes X, Y, Z"),
        ("xfyz", "expected 'w'"),
    ],
)
def test_impossible_chain_strings(text, told):
    with pytest.raises(ValueError, match=told) as refused:
        chain_from_string(text)
    assert repr(text) in str(refused.value)


@pytest.mark.parametrize("text", CHAINS)
def test_linear_axes(text, rng):
    """Without errors the tool point is command plus tool offset; with them, the oracle's."""
    chain = chain_from_string(text, SPANS, TOOL)
    q = rng.uniform(*TRAVEL.T, (ROWS, 3))
    np.testing.assert_allclose(points(chain, q), q + TOOL, rtol=0, atol=1e-15)
    # Errors a hundred times those of a real machine, so that products of errors count.
    translation, turned = rng.normal(0, 2e-3, (2, ROWS, 3, 3))
    tool = rng.normal(0, 1e-4, (ROWS, 3))
    machine = nominal_machine(text, TRAVEL, TOOL)
    expected = compose(machine, q, translation, turned, np.array(TOOL) + tool)
    got = points(chain, q, translation, turned, tool)
    np.testing.assert_allclose(got, expected, rtol=0, atol=1e-12)
    assert np.abs(got - q - TOOL).max() > 1e-3


@pytest.mark.parametrize("text", CHAINS)
@pytest.mark.parametrize(
    ("name", "axis", "tilt"),
    [("EC0Y", 1, (-1, 0, 0)), ("EB0Z", 2, (1, 0, 0)), ("EA0Z", 2, (0, -1, 0))],
)
def test_squareness_signs(text, name, axis, tilt, rng):
    """A squareness tilts the motion relative to the workpiece, whichever side carries the axis."""
    chain = chain_from_string(text, SPANS, TOOL)
    effect = GeometricErrors(locations=(LocationError.of(chain, name, 100e-6),))
    q = rng.uniform(*TRAVEL.T, (ROWS, 3))
    terms = effect_terms(effect, PortLayout.of(chain.axes, ()), Plan(chain.axes, q), {})
    moved = points_of(chain, q, terms, [1.0]) - q - TOOL
    expected = 100e-6 * q[:, axis, None] * np.array(tilt)
    np.testing.assert_allclose(moved, expected, rtol=0, atol=1e-15)


def points_of(chain, q, terms, theta):
    """Tool points of a model's terms."""
    ports = port_values(terms, jnp.asarray(theta, float), terms.offset.shape[1])
    return np.asarray(tool_points(chain, q, ports))


@pytest.mark.parametrize("text", CHAINS)
def test_declared_family_against_the_oracle(text, rng):
    """A machine of the oracle, told to vcal coefficient by coefficient, has its tool points."""
    machine = draw_machine(nominal_machine(text, TRAVEL, TOOL), rng, size=10.0)
    chain = chain_from_string(text, SPANS, TOOL)
    motions, values = [], []
    for name in (f"E{c}{axis}" for axis in "XYZ" for c in "XYZABC"):
        a0, a1, n1, b1, c1, n2, b2, c2 = UM * np.array(TABLE[name])
        harmonics = [(n1 / UM, b1, c1), (n2 / UM, b2, c2)]
        motions.append(ErrorMotion(name, name[2], Fourier(SPANS[name[2]], a0, a1, harmonics)))
        true = dict(zip(("a0", "a1", "n1", "b1", "c1", "n2", "b2", "c2"),
                        machine.coefficients()[name], strict=True))  # fmt: skip
        values += [UM * true[label] for label in motions[-1].basis.labels]
    locations = tuple(LocationError.of(chain, name, 1.0) for name in ("EC0Y", "EB0Z", "EA0Z"))
    effect = GeometricErrors(motions=tuple(motions), locations=locations)
    run = check_plan(machine, rng, ROWS)
    terms = effect_terms(effect, PortLayout.of(chain.axes, ()), Plan(chain.axes, run.q), {})
    theta = np.array([*values, *machine.squareness]) / [p.step for p in effect.amplitudes]
    got = points_of(chain, run.q, terms, theta)
    np.testing.assert_allclose(got, tool_point(machine, run), rtol=0, atol=1e-12)


def test_exact_rotations_against_the_printed_small_angle_form(rng):
    """Seed 003, eq. (1) and (5)-(9), on a 3 m machine with errors of 50 um and 50 urad.

    Printed: R_X^-1 (R_Y (R_Z T + Z) + Y - X); "- Z" for the last term there is a misprint.
    S_xy = EC0Y, S_xz = -EB0Z, S_yz = EA0Z.
    """
    chain = chain_from_string("XFYZ", {"X": (0, 3), "Y": (0, 1.5), "Z": (0, 1.3)}, (0, 0, -0.2))
    n = ROWS
    q = rng.uniform(0, [3, 1.5, 1.3], (n, 3))
    delta = 50e-6 * rng.choice([-1.0, 1.0], (n, 3, 3))
    epsilon = 50e-6 * rng.choice([-1.0, 1.0], (n, 3, 3))
    s_xy, s_xz, s_yz = squareness = 50e-6 * np.array([1.0, -1.0, 1.0])
    printed = np.empty((n, 3))
    for k, ((x, y, z), d) in enumerate(zip(q, delta, strict=True)):
        r = [np.eye(3) + np.asarray(skew(e)) for e in epsilon[k]]
        moved_x = np.array([-x, 0, 0]) + d[0]
        moved_y = np.array([-y * s_xy, y, 0]) + d[1]
        moved_z = np.array([-z * s_xz, -z * s_yz, z]) + d[2]
        tool = r[2] @ [0, 0, -0.2] + moved_z
        printed[k] = np.linalg.solve(r[0], r[1] @ tool + moved_y - moved_x)
    names = zip(("EC0Y", "EB0Z", "EA0Z"), squareness * [1, -1, 1], strict=True)
    locations = tuple(LocationError.of(chain, name, value) for name, value in names)
    layout, plan = PortLayout.of(chain.axes, ()), Plan(chain.axes, q)
    terms = effect_terms(GeometricErrors(locations=locations), layout, plan, {})
    tilts = np.asarray(port_values(terms, jnp.ones(3), len(layout)))[:, :18].reshape(n, 3, 6)
    exact = points(chain, q, delta + tilts[:, :, :3], epsilon)
    largest = np.linalg.norm(exact - printed, axis=1).max()
    assert 1e-9 < largest < 0.1e-6  # some 20 nm
    assert np.linalg.norm(exact - q - [0, 0, -0.2], axis=1).max() > 100e-6


# --- arms ----------------------------------------------------------------------------------------


def dh_rows(arm, prismatic=()):
    return [
        {
            "type": "prismatic" if j in prismatic else "revolute",
            "a": arm.a[j],
            "d": arm.d[j],
            "alpha": arm.alpha[j],
            "theta": arm.theta[j],
            "low": -1.0 - j,
        }
        for j in range(arm.joints)
    ]


@pytest.mark.parametrize("prismatic", [(), (2,), (0, 5)])
def test_arm_against_the_oracle(prismatic, rng):
    arm = example_arm()
    slides = np.isin(np.arange(6), prismatic)
    arm = type(arm)(arm.a, arm.alpha, arm.d, arm.theta, slides)
    chain = chain_from_dh(dh_rows(arm, prismatic), TOOL)
    assert chain.axes == ("J1", "J2", "J3", "J4", "J5", "J6")
    np.testing.assert_array_equal(chain.joint("J3").travel, [-3.0, np.inf])
    q = rng.uniform(-1.5, 1.5, (ROWS, 6))
    frames, origins = arm_frames(arm, q)
    expected = origins[:, -1] + frames[:, -1] @ TOOL
    np.testing.assert_allclose(points(chain, q), expected, rtol=0, atol=1e-12)
    translation, turned = rng.normal(0, 2e-3, (2, ROWS, 6, 3))
    # A slide moves first and errs then, in front of its link: to the oracle, all of it is error.
    slid = translation + np.where(slides, q, 0.0)[:, :, None] * np.eye(3)[2]
    moved, ends = arm_frames(arm, np.where(slides, 0.0, q), slid, turned)
    expected = ends[:, -1] + moved[:, -1] @ TOOL
    got = points(chain, q, translation, turned)
    np.testing.assert_allclose(got, expected, rtol=0, atol=1e-12)
    rotations, starts = chain.frames(q)
    np.testing.assert_allclose(starts, origins[:, :-1], atol=1e-14)
    np.testing.assert_allclose(rotations[..., 2], frames[:, :-1, :, 2], atol=1e-14)


def test_constant_link_errors_are_the_oracles(rng):
    arm = example_arm()
    chain = chain_from_dh(dh_rows(arm), TOOL)
    effect = link_errors(chain, 5e-4, 2e-3)
    q = rng.uniform(-1.5, 1.5, (ROWS, 6))
    theta = rng.standard_normal((6, 6))
    terms = effect_terms(effect, PortLayout.of(chain.axes, ()), Plan(chain.axes, q), {})
    frames, origins = arm_frames(arm, q, 5e-4 * theta[:, :3], 2e-3 * theta[:, 3:])
    expected = origins[:, -1] + frames[:, -1] @ TOOL
    got = points_of(chain, q, terms, theta.ravel())
    np.testing.assert_allclose(got, expected, rtol=0, atol=1e-12)
