"""NC programs: where the corrected program drives the tool, as others read it."""

import shutil

import numpy as np
import pytest

from nc_programs import Author, machine_displacement, short_arcs, zero
from oracle import nc
from vcal.compensation.nc import NcOptions, correct_program

HALF = 0.5e-4
"""Half of the default resolution, mm."""


def corrected(program: bytes, displacement, **options):
    return correct_program(program, displacement, NcOptions(**options))


def actual(moves, displacement, spacing=0.05):
    """Where the tool is while the moves are driven, mm, with the number of the move."""
    path, index, direction = nc.sampled(moves, spacing)
    return path + 1e3 * displacement(1e-3 * path, direction), index


def fed(moves):
    """Moves along which the path matters."""
    return [m for m in moves if m.motion and m.length > 0]


@pytest.mark.parametrize("seed", range(10))
def test_without_errors_the_program_stays_byte_for_byte(seed):
    program = Author(seed).program(60)
    done = corrected(program, zero)
    assert done.program == program
    assert done.report.corrected == done.report.split == 0
    assert done.report.blocks_in == done.report.blocks_out == len(program.splitlines())
    assert done.report.moves > 30 and not done.report.warnings


@pytest.mark.parametrize("seed", range(6))
def test_the_displaced_tool_follows_the_programmed_path(seed):
    """A true machine (exact kinematics, oracle) driven by the corrected program, as read by an
    independent interpreter: at most the tolerance and the resolution are left.
    """
    program = Author(100 + seed).program(30)
    displacement = machine_displacement(seed)
    done = corrected(program, displacement)
    wanted, driven = (nc.driven(p.decode("latin-1")) for p in (program, done.program))
    reference, _, _ = nc.sampled(fed(wanted), 0.05)
    before = nc.distance_to(actual(fed(wanted), displacement)[0][::20], reference)
    tool, _ = actual(fed(driven), displacement)
    off = nc.distance_to(tool[::2], reference)
    resolution = 25.4e-5 if b"G20" in program.upper() else 1e-4
    assert before.max() > 8e-3  # mm: there was something to correct
    assert off.max() < 1e-3 + resolution
    # and the other way round: no part of the programmed path is left out
    back = nc.distance_to(reference[::3], tool)
    assert back.max() < 1e-3 + resolution
    ends = [m.end for m in wanted]
    reached = np.array([m.end + 1e3 * displacement(1e-3 * m.end[None], None)[0] for m in driven])
    assert all(np.linalg.norm(reached - end, axis=1).min() < 2 * resolution for end in ends)


@pytest.mark.parametrize("seed", [10, 13])
def test_short_arcs_are_never_driven_the_long_way_round(seed):
    """Arcs whose middle is a tenth of a micrometre off the chord: rounding of both ends can bend
    them to the other side, on which the same words are nearly a whole turn.
    """

    def displacement(positions, directions):
        return 1e-5 * np.sin(7.0 * positions + [0.0, 1.0, 2.0]) + 4e-5 * positions[:, [1, 2, 0]]

    done = corrected(short_arcs(seed), displacement)
    arcs = [m for m in nc.driven(done.program.decode()) if m.motion > 1]
    assert len(arcs) > 800
    assert max(abs(m.turn) for m in arcs) < 0.05


@pytest.mark.parametrize("seed", range(2))
def test_lost_motion_is_taken_up(seed):
    """Play of every axis, as the play operator, beside errors that change with the position."""
    half = np.array([6e-3, 4e-3, 9e-3])
    program = Author(300 + seed, arcs=False, diagonal=True).program(40)
    geometric = machine_displacement(seed, 0.3)

    def displacement(positions, directions):
        return geometric(positions, directions) - 1e-3 * half * directions

    done = corrected(program, displacement)
    wanted, driven = (nc.driven(p.decode("latin-1")) for p in (program, done.program))
    path, _, _ = nc.sampled(driven[1:], 0.05)
    tool = nc.play(path, half)
    tool += 1e3 * geometric(1e-3 * path, None)
    reference, _, _ = nc.sampled(wanted[1:], 0.05)
    # until every axis has passed its play once, nobody knows where in it the tool is
    known = np.cumsum(np.linalg.norm(np.diff(path, axis=0), axis=1)) > 0.2
    off = nc.distance_to(tool[1:][known][::2], reference)
    plain = nc.play(reference, half) + 1e3 * geometric(1e-3 * reference, None)
    assert nc.distance_to(plain[::10], reference).max() > 8e-3
    assert off.max() < 1e-3 + 25.4e-5


def test_a_circle_with_lost_motion_is_split_where_axes_turn_round():
    """By quadrants, with a block of the size of the play at every reversal (closed form)."""
    half = np.array([5e-3, 3e-3, 0.0])

    def displacement(positions, directions):
        return -1e-3 * half * directions

    program = b"G21 G90 G17\nG0 X50 Y0 Z0\nG0 X40 Y-1\nG1 X40 Y0 F500\nG3 X40 Y0 I-40 J0\nM2\n"
    done = corrected(program, displacement)
    moves = nc.driven(done.program.decode())
    arcs = [m for m in moves if m.motion == 3]
    jumps = [m for m in moves if m.motion == 1 and m.line > arcs[0].line]
    assert len(arcs) == 4
    assert [m.turn for m in arcs] == pytest.approx([np.pi / 2] * 4, abs=1e-4)
    # X already came from above, Y turns round at the top: +-Y, +-X, +-Y
    sizes = [np.abs(m.end - m.start).max() for m in jumps]
    assert sizes == pytest.approx([0.006, 0.010, 0.006], abs=2e-4)
    path, _, _ = nc.sampled(nc.driven(done.program.decode())[2:], 0.01)
    tool = nc.play(path, half)
    radius = np.linalg.norm(tool[len(tool) // 8 :, :2], axis=1)
    assert np.abs(radius - 40.0).max() < 3e-4


def test_a_scale_error_of_a_line_is_its_end():
    """x = X (1 + a): every command is X / (1 + a), and no line is split (closed form)."""
    a = 200e-6
    done = corrected(
        b"G21 G90\nG0 X0 Y0 Z0\nG1 X250.0 F100\nG91 G1 X-100\nG1 X-0.3\n",
        lambda p, d: p * [a, 0, 0],
    )
    lines = done.program.decode().splitlines()
    assert lines[2] == f"G1 X{250 / (1 + a):.4f}".rstrip("0") + " F100"
    assert lines[3] == "G91 G1 X-99.98"
    assert len(lines) == 5 and done.report.split == 0
    assert done.report.largest_um == pytest.approx(1e6 * 0.25 * a / (1 + a), abs=1e-3)
    assert done.report.largest_line == 3


def test_a_scale_error_of_a_circle_stays_arcs():
    """Both axes too long by the same share: arcs of a smaller radius, about a moved centre."""
    a = 300e-6
    done = corrected(b"G21 G90\nG0 X30 Y10 Z0\nG2 X30 Y10 I15 F100\n", lambda p, d: p * [a, a, 0])
    arcs = [m for m in nc.driven(done.program.decode()) if m.motion == 2]
    assert len(arcs) == 4
    for arc in arcs:
        assert arc.centre == pytest.approx((45 / (1 + a), 10 / (1 + a)), abs=3e-4)
        assert np.hypot(*(arc.start[:2] - arc.centre)) == pytest.approx(15 / (1 + a), abs=3e-4)


def test_a_period_that_midpoints_do_not_see_is_seen():
    """A cyclic error with zeros at both ends, the middle and the quarters of a line."""

    def displacement(p, d):
        return np.stack([0 * p[:, 0], 5e-6 * np.sin(2 * np.pi * p[:, 0] / 5e-3), 0 * p[:, 0]], 1)

    program = b"G21 G90\nG0 X0 Y0 Z0\nG1 X40 F100\n"
    for tolerance in (0.5, 1.0, 3.0):
        done = corrected(program, displacement, tolerance_um=tolerance)
        tool, _ = actual(fed(nc.driven(done.program.decode())), displacement, 0.01)
        assert np.abs(tool[:, 1]).max() < 1e-3 * tolerance + 1e-4
    assert done.report.split == 1


@pytest.mark.parametrize("resolution", [0.0001, 0.001, 0.0005])
def test_roundings_of_increments_do_not_add_up(resolution):
    steps = 3000
    program = "G21 G90\nG0 X0 Y0 Z0\nG91\n" + "G1 X0.1 Y0.03333\n" * steps
    done = corrected(
        program.encode(), lambda p, d: 37e-6 * p[:, [1, 0, 2]], resolution_mm=resolution
    )
    end = nc.driven(done.program.decode())[-1].end
    tool = end + 37e-6 * end[[1, 0, 2]]
    assert np.abs(tool - [0.1 * steps, 0.03333 * steps, 0.0]).max() < 0.6 * resolution
    numbers = [w for w in done.program.decode().replace("\n", " ").split() if w[0] == "X"]
    ticks = np.array([float(w[1:]) for w in numbers]) / resolution
    assert np.abs(ticks - np.round(ticks)).max() < 1e-6


def test_inverse_time_is_shared_by_length():
    program = b"G21 G90 G93\nG0 X0 Y0 Z0\nG1 X200 Y100 F2.5\nG3 X150 Y150 I-50 J0 F4\nG94\n"
    done = corrected(program, machine_displacement(3))
    moves = [m for m in nc.driven(done.program.decode()) if m.minutes]
    straight = [m for m in moves if m.motion == 1]
    assert len(straight) > 3
    assert sum(m.minutes for m in straight) == pytest.approx(1 / 2.5, rel=1e-5)
    assert sum(m.minutes for m in moves if m.motion == 3) == pytest.approx(1 / 4, rel=1e-5)
    speeds = [m.length / m.minutes for m in straight]
    assert np.ptp(speeds) / np.mean(speeds) < 2e-3


needs_rs274 = pytest.mark.skipif(
    shutil.which("rs274") is None,
    reason="LinuxCNC's stand-alone interpreter rs274 is not installed",
)


@needs_rs274
@pytest.mark.parametrize("seed", range(5))
def test_linuxcnc_reads_the_corrected_program_as_the_oracle_does(seed, tmp_path):
    program = Author(500 + seed).program(60)
    done = corrected(program, machine_displacement(seed))
    for text in (program, done.program):
        ours = [m for m in nc.driven(text.decode("latin-1")) if m.length > 0]
        theirs = nc.rs274(text, tmp_path)
        theirs = [
            m
            for k, m in enumerate(theirs)
            if m[0] > 1 or k == 0 or (m[1] != theirs[k - 1][1]).any()
        ]
        assert len(theirs) > 40
        assert [m.motion for m in ours] == [motion for motion, _ in theirs]
        ends = np.array([m.end for m in ours]) - np.array([end for _, end in theirs])
        printed = 25.4e-4 if b"G20" in program.upper() else 1e-4
        assert np.abs(ends).max() < 0.6 * printed
