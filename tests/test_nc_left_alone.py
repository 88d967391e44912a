"""NC programs: blocks that are left as they are, ways of writing, options and messages."""

import time

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from oracle import nc
from vcal import StudyError
from vcal.compensation.nc import NcOptions, correct_file, correct_program

OFFSET = np.array([0.010, -0.020, 0.030])
"""Displacement, mm, of a machine that is off by the same vector everywhere."""


def off(positions, directions, *tools):
    return np.broadcast_to(1e-3 * OFFSET, positions.shape)


def lines_of(text: str, displacement=off, **options):
    """Corrected lines, and warnings as (line, words)."""
    done = correct_program(text.encode("latin-1"), displacement, NcOptions(**options), "part.ngc")
    return done.program.decode("latin-1").split("\n"), done.report


HEAD = "G21 G90 G17 G94\nG0 X0 Y0 Z0\n"


def test_every_axis_gets_a_word_where_it_has_to_move():
    lines, report = lines_of(HEAD + "G1 X10 F100\nY5\nZ-1\nX10\n")
    assert lines[1:] == [
        "G0 X-0.01 Y0.02 Z-0.03", "G1 X9.99 F100", "Y5.02", "Z-1.03", "X9.99", "",
    ]  # fmt: skip
    assert report.largest_um == pytest.approx(1e3 * np.linalg.norm(OFFSET))
    assert (report.moves, report.corrected, report.split, report.left) == (5, 5, 0, 0)


@pytest.mark.parametrize(
    ("written", "read"),
    [
        ("g1x10y5f100", "g1x9.99y5.02f100"),
        ("N0030G01X+0010.Y5F100M8", "N0030G01X9.99Y5.02F100M8"),
        ("  G 1  X 1 0 . 0\tY5 (to X99) F100 ; Y99", "  G 1  X9.99\tY5.02 (to X99) F100 ; Y99"),
        ("/2 G1 X10 Y5", "/2 G1 X9.99 Y5.02"),
        ("G1 X10 Y5 T2 S500 H3 D4", "G1 X9.99 Y5.02 T2 S500 H3 D4"),
        ("G1 X10. Y-.5", "G1 X9.99 Y-0.48"),
        ("G91 X10 Y5", "G91 X10 Y5"),
        ("M3 $0 S100", "M3 $0 S100"),
        ("G4 P0.5", "G4 P0.5"),
        ("G4 X1.5", "G4 X1.5"),
        ("(G1 X10) M3 S100", "(G1 X10) M3 S100"),
        ("G64 P0.01", "G64 P0.01"),
        ("G22 X100 Y100 Z100 I0 J0 K0", "G22 X100 Y100 Z100 I0 J0 K0"),
        ("G92 S3000", "G92 S3000"),
        ("G28.1", "G28.1"),
        ("G5.1 Q1", "G5.1 Q1"),
    ],
)
def test_ways_of_writing(written, read):
    lines, report = lines_of(HEAD + f"G1 X3 F100\n{written}\n")
    assert lines[3] == read
    assert not report.warnings


@pytest.mark.parametrize("eol", ["\n", "\r\n", "\r"])
@pytest.mark.parametrize("last", [True, False])
def test_ends_of_lines_and_bytes_stay(eol, last):
    text = eol.join(
        ["\xef\xbb\xbf%", "O0001(\xe4\x93\x00)", "G21", "G0X0Y0Z0", "", "G1X100Y5", "%\x1a"]
    )
    text += eol * last

    def bent(positions, directions):
        return 2e-2 * positions[:, :1] ** 2 * np.array([0, 1.0, 0])

    done = correct_program(text.encode("latin-1"), bent).program.decode("latin-1")
    assert done.count("X") > 4
    assert set(done.replace(eol, "")).isdisjoint("\r\n")
    kept = text.split(eol)
    assert done.split(eol)[:5] == kept[:5]
    assert done.endswith("%\x1a" + eol * last)


@pytest.mark.parametrize(
    ("blocks", "words", "moves"),
    [
        ("G81 X5 Y5 Z-3 R2 F100\nX6\nY7\nG80", "G81: the positions of a canned cycle", 3),
        ("G73 X5 Y5 Z-3 R2 Q1 F100\nG80", "G73", 1),
        ("G28 X5", "G28: move to the reference position", 1),
        ("G30", "G30", 1),
        ("G53 G0 Z0", "G53: move in machine coordinates", 1),
        ("G38.2 Z-5 F50", "G38.2: probing", 1),
        ("G31 Z-5 F50", "G31", 1),
        ("G41 D1 X5\nX6 Y7\nG2 X8 Y7 I1\nG40", "G41: cutter radius compensation", 3),
        ("G68 X0 Y0 R30\nG1 X5\nG69", "G68: rotated coordinates", 2),
        ("G51 X0 Y0 P2\nG1 X5\nG50", "G51: scaling", 2),
        ("G51.1 X0\nG1 X5\nG50.1", "G51.1: mirror image", 2),
        ("G16\nG1 X5 Y30\nG15", "G16: polar coordinates", 1),
        ("G92 X0\nG1 X5\nG92.1", "G92: coordinate system shift", 1),
        ("G52 X5\nG1 X5\nG52 X0", "G52: local coordinate system", 1),
        ("G12.1\nX5\nG13.1", "G12.1: polar interpolation", 1),
        ("G5 I0 J3 P0 Q-3 X1 Y1", "G5: spline", 1),
        ("G1 X#1 Y[2+[3*#2]]", "variables and expressions are not evaluated", 1),
        ("G1 @5 ^30", "polar words are not read", 1),
        ("G1 X1 X2", "a letter occurs twice", 1),
        ("G1 X5 R2", "words I, J, K or R in a straight move", 1),
        ("G2 X5 Y5", "an arc whose circle is not determined", 1),
        ("G2 X5 Y5 I1 J1", "an arc whose circle is not determined", 1),
        ("G2 X3 Y0 R5", "an arc whose circle is not determined", 1),
        ("G80\nX5", "axis words without a code of motion", 1),
        ("M98 P1000", "M98: a subprogram is called", 0),
        ("o<drill> call [1] [2]", "O-word call <drill>", 0),
        ("G65 P9000 X5", "G65: a macro is called", 0),
        ("o1 if [#1 GT 2]\nG1 X5\no1 endif", "O-word if 1: control flow", 1),
        ("O2 DO\nG1 X5\nG91 X3\nG90\nO2 WHILE [#1 LT 2]", "O-word do 2: control flow", 2),
        ("A30\nG1 X5", "axis A has moved", 1),
    ],
)
def test_what_cannot_be_corrected_is_left_and_reported(blocks, words, moves):
    """The blocks stay byte for byte, the warning has their line, and increments after them are not
    corrected until all axes were given again.
    """
    text = HEAD + f"G1 X3 F100\n{blocks}\nG91 G17\nG1 X1 Z1\nG90 G54\nG1 X4 Y4\n"
    lines, report = lines_of(text)
    size = blocks.count("\n") + 1
    assert lines[3 : 3 + size] == blocks.split("\n")
    (found,) = [w for w in report.warnings if words in w.text]
    assert 4 <= found.lines[0] < 4 + size and found.moves >= moves
    assert f"line {found.lines[0]}: " in report.text()
    whole = text.encode("latin-1")
    assert correct_program(whole, lambda p, d: 0.0 * p).program == whole
    if "A30" not in blocks:
        assert lines[3 + size : 5 + size] == ["G91 G17", "G1 X1 Z1"]
        again, _ = lines_of(text.replace("X4 Y4", "X4 Y4 Z4"))
        assert again[6 + size] == "G1 X3.99 Y4.02 Z3.97"


def test_a_rotary_axis_holds_corrections_back_until_it_is_at_zero_again():
    lines, report = lines_of(HEAD + "G0 A30\nG1 X5 F100\nG91 Y1\nG90 A0 X6\nX7\n")
    assert lines[2:] == ["G0 A30", "G1 X5 F100", "G91 Y1", "G90 A0 X6", "X5.99", "X6.99", ""]
    (warning,) = report.warnings
    assert (warning.lines, warning.moves, warning.last) == ((3,), 3, 6)


def test_extrusion_is_not_shared():
    lines, report = lines_of(HEAD + "G1 X5 Y0 Z0 E2 F100\nG1 X6\n")
    assert lines[2:5] == ["G1 X5 Y0 Z0 E2 F100", "G1 X4.99 Y0.02 Z-0.03", "X5.99"]
    assert report.warnings[0].lines == (3,)


@pytest.mark.parametrize("block", ["G80 G0 X5", "G0 G80 X5", "X5 G01 G80"])
def test_order_of_codes_in_a_block(block):
    lines, _ = lines_of(HEAD + f"{block}\n")
    assert lines[2] == block.replace("X5", "X4.99")


def test_moves_of_the_control_set_the_modal_motion_too():
    text = HEAD + "G1 X5 F100\nG53 G0 Z0\nX6 Y6 Z6\n"
    lines, _ = lines_of(text)
    assert lines[3:5] == ["G53 G0 Z0", "X5.99 Y6.02 Z5.97"]


def test_loops_of_macros_end_what_is_known():
    lines, report = lines_of(HEAD + "IF [#1 EQ 2] GOTO 10\nG1 X5 F100\nN10 X6\nM30\n")
    assert lines[2:] == ["IF [#1 EQ 2] GOTO 10", "G1 X5 F100", "N10 X6", "M30", ""]
    (warning,) = report.warnings
    assert warning.lines == (3,) and warning.moves == 2 and warning.last == 5


@pytest.mark.parametrize("setting", ["G10 L2 P1 X0 Y0 Z0", "#5221 = 3", "#[5220+#1]=2"])
def test_changed_offsets_end_what_is_known(setting):
    lines, report = lines_of(HEAD + f"{setting}\nG1 X5 Y5 Z5 F100\n")
    assert lines[3] == "G1 X5 Y5 Z5 F100"
    assert report.left == 1 and report.warnings[0].lines == (3,)


def test_other_variables_change_nothing():
    lines, report = lines_of(HEAD + "#100 = 3 #<depth>=[2*#100]\nG1 X5 F#100\n")
    assert lines[2:4] == ["#100 = 3 #<depth>=[2*#100]", "G1 X4.99 F#100"]


def test_definitions_of_subprograms_are_passed_over():
    sub = "o<a> sub\nG91 G20\nG1 X5\no<a> endsub\n"
    lines, report = lines_of(HEAD + sub + "X7\n")
    assert lines[2:7] == [*sub.split("\n")[:4], "X6.99"]
    assert report.warnings[0].moves == 1


def test_blocks_after_the_end_are_not_read():
    lines, report = lines_of(HEAD + "M30\nO1000\nG1 X5 G187\nM99\n")
    assert lines[2:] == ["M30", "O1000", "G1 X5 G187", "M99", ""]
    (warning,) = report.warnings
    assert "after the end" in warning.text and warning.lines == (5,)


def test_an_arc_left_as_it_is_begins_where_its_circle_does():
    """Otherwise its radii at both ends would differ, and a control would stop."""
    lines, _ = lines_of(HEAD + "G1 X10 F100\nG28 Z0\nG2 X14 Y0 I2 J0\nX18 I2\n")
    assert lines[4:7] == ["G1 X10.0 Y0.0", "G2 X14 Y0 I2 J0", "X18 I2"]


def test_modal_motion_is_kept():
    """A tiny arc becomes a straight line; the next block still means an arc."""
    lines, report = lines_of(HEAD + "G3 X0.002 Y0 R5 F100\nX10 Y10 R10\n", resolution_mm=0.0001)
    assert lines[2] == "G1 X-0.008 Y0.02 F100"
    assert lines[3].startswith("G3 X9.99 Y10.02 R")
    assert [m.motion for m in nc.driven("\n".join(lines))] == [0, 1, 3]


def test_small_arcs_follow_their_circle():
    """Radii down to a few resolutions, with a machine of large errors."""
    arcs = "".join(
        f"G2 I{r} F100\nG3 X{3 * r} R{2 * r}\nX0 I-{1.5 * r}\n" for r in (0.002, 0.02, 0.2, 1)
    )

    def skewed(positions, directions):
        return positions[:, [1, 0, 2]] * [3e-3, 2e-3, 0.0] + [1e-4, 2e-4, 0.0]

    lines, _ = lines_of(HEAD + arcs, skewed)
    path, _, _ = nc.sampled(nc.driven("\n".join(lines))[2:], 0.001)
    tool = path + 1e3 * skewed(1e-3 * path, None)
    wanted, _, _ = nc.sampled(nc.driven(HEAD + arcs)[1:], 0.001)
    assert nc.distance_to(tool[::3], wanted).max() < 1.1e-3


def test_several_turns():
    text = HEAD + "G1 X10 F100\nG3 X0 Y10 Z-9 I-10 J0 P3\n"
    lines, _ = lines_of(text, lambda p, d: 3e-4 * p[:, [1, 2, 0]])
    moves = nc.driven("\n".join(lines))
    arcs = [m for m in moves if m.motion == 3]
    assert sum(m.turn for m in arcs) == pytest.approx(4.5 * np.pi, abs=1e-3)
    path, _, _ = nc.sampled(moves[2:], 0.02)
    wanted, _, _ = nc.sampled(nc.driven(text)[2:], 0.02)
    assert nc.distance_to(path + 3e-4 * path[:, [1, 2, 0]], wanted).max() < 1.1e-3


def test_m_codes_keep_their_side_of_a_split_move():
    def bent(positions, directions):
        return 2e-2 * positions[:, :1] ** 2 * np.array([0, 1.0, 0])

    lines, report = lines_of(HEAD + "N5 G1 X100 F100 M8 S900 M9 M21 (end)\nM30\n", bent)
    assert len(lines) > 8
    assert lines[2].startswith("N5 G1 X") and lines[2].endswith("F100 M8 S900 M21 (end)")
    assert lines[-3].endswith(" M9") and lines[-2] == "M30"
    assert all("M" not in line for line in lines[3:-3])
    (warning,) = report.warnings
    assert warning.lines == (3,) and "M21" in warning.text


def test_axis_positions_are_program_coordinates_and_offsets():
    seen = []

    def watched(positions, directions):
        seen.append(positions)
        return np.zeros_like(positions)

    offsets = {"G54": (100, 50, -20), "G54.1 P3": (200, 0, 0)}
    text = "G21 G90\nG0 X1 Y2 Z3\nG54.1 P3\nG0 X1 Y2 Z3\nG20\nG0 X1\n"
    lines_of(text, watched, work_offsets_mm=offsets)
    found = np.unique(np.round(1e3 * np.concatenate(seen), 9), axis=0)
    assert found.tolist() == [[101, 52, -17], [201, 2, 3], [225.4, 2, 3]]


def test_tool_lengths():
    seen = []

    def watched(positions, directions, lengths):
        seen.append(np.column_stack([positions, lengths]))
        return off(positions, directions)

    text = "G21 G90\nT1 M6\nG0 X1 Y2\nG43 H1 Z3\nG49\nX5\nT2 M6\nG0 X1 Y1\nG43 H2\nG0 Z7\n"
    lines, report = lines_of(text, watched, tool_lengths_mm={1: 80.0, 2: 120.0})
    found = np.unique(np.round(1e3 * np.concatenate(seen), 6), axis=0)
    assert {tuple(row) for row in found} >= {(1, 2, 83, 80), (1, 1, 127, 120)}
    assert lines[5] == "X5" and "tool length" in report.text()
    assert lines[9] == "G0 Z6.97 X0.99 Y1.02"
    _, assumed = lines_of(text)
    assert "the tool of the calibration for H1, H2" in assumed.text()


def test_skipped_blocks():
    text = HEAD + "/G1 X5 F100\nG1 Y5 F100\n"
    run, report = lines_of(text)
    assert run[2:4] == ["/G1 X4.99 F100", "G1 Y5.02 F100"]
    assert "slash are executed (first in line 3)" in report.text()
    skipped, _ = lines_of(text, skip_deleted=True)
    assert skipped[2:4] == ["/G1 X5 F100", "G1 Y5.02 F100"]


def test_assumptions_are_said():
    _, report = lines_of("G0 X0 Y0 Z0\n")
    said = " / ".join(report.assumptions)
    assert "does not name its unit: mm" in said
    assert "no work offset was given" in said
    assert "without a decimal point" in said
    _, quiet = lines_of("G21 G0 X0. Y0. Z0.\n", work_offsets_mm={"G54": (1, 2, 3)})
    assert quiet.assumptions == ()


def test_a_feed_from_an_unknown_position():
    lines, report = lines_of("G21 G90\nG1 X1 Y1 Z1 F100\n")
    assert lines[1] == "G1 X0.99 Y1.02 Z0.97 F100"
    assert report.warnings[0].lines == (2,) and "only its end" in report.warnings[0].text


# --- messages -------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("text", "options", "message"),
    [
        ("G21\nG187 P1\n", {}, r"part.ngc, line 2: found G187, .* ignored_codes"),
        ("G21\nG71 P10 Q20\n", {}, "line 2: found G71 with further words"),
        ("G21\nL X+10 FMAX\n", {}, r"line 2: found 'L X\+10 FMAX', expected words of a letter"),
        ("X10 (no end\n", {}, r"line 1: found '\(no end'"),
        ("G#5 X1\n", {}, "line 1: found a G word with a variable"),
        ("G55\n", {}, "line 1: found G55, expected only G54, as no work offsets"),
        ("G55\n", {"work_offsets_mm": {"G54": (0, 0, 0)}}, r"line 1: found G55, .*\(G54\)"),
        ("\nG0 X1\n", {"work_offsets_mm": {"G55": (0, 0, 0)}}, r"line 2: found a move in G54"),
        ("G43 H4\n", {"tool_lengths_mm": {1: 5.0}}, r"line 1: found H4, .*\(H1\)"),
        ("", {"work_offsets_mm": {"G53": (0, 0, 0)}}, "option work offset: found 'G53'"),
        ("", {"work_offsets_mm": {"G54": (0, 0)}}, r"option work offset G54: found \[0, 0\]"),
        ("", {"tolerance_um": 0.05}, "option tolerance_um: found 0.05, expected at least"),
        ("", {"resolution_mm": -1.0}, "option resolution_mm: found -1"),
        ("", {"units": "cm"}, "option units: found 'cm'"),
        ("", {"ignored_codes": ["M5"]}, "option ignored_codes: found 'M5'"),
        ("\xff\xfeG\x000\x00", {}, "part.ngc: found UTF-16"),
    ],
)
def test_messages(text, options, message):
    with pytest.raises(StudyError, match=message):
        lines_of(text, **options)


def test_codes_can_be_ignored():
    lines, report = lines_of(HEAD + "G187 P1\nG1 X5 F100\n", ignored_codes=("G187",))
    assert lines[2:4] == ["G187 P1", "G1 X4.99 F100"] and not report.warnings


@pytest.mark.parametrize(
    ("displacement", "message"),
    [
        (lambda p, d: np.where(p > 0.05, np.nan, 0.0), "X = 100.000 mm.*no finite number"),
        (lambda p, d: 0.1 - 3.0 * p, "does not converge"),
    ],
)
def test_a_displacement_that_cannot_be_used(displacement, message):
    with pytest.raises(StudyError, match=message):
        lines_of("G21\nG0 X100 Y0 Z0\n", displacement)


def test_a_step_along_a_line_is_reported():
    lines, report = lines_of(
        HEAD + "G1 X100 F100\n", lambda p, d: np.where(p[:, :1] > 0.0333, [0, 5e-5, 0], 0.0)
    )
    assert any("too fast" in w.text and w.lines == (3,) for w in report.warnings)


# --- files and speed ------------------------------------------------------------------------------


def test_files(tmp_path):
    path, out = tmp_path / "part.ngc", tmp_path / "corrected.ngc"
    path.write_bytes((HEAD + "G1 X10 F100\n").encode())
    report = correct_file(path, out, off)
    assert out.read_bytes() == correct_program(path.read_bytes(), off).program
    assert report.name == "part.ngc" and report.blocks_in == 3
    with pytest.raises(StudyError, match="must not be corrected twice"):
        correct_file(path, path, off)
    with pytest.raises(StudyError, match="found no file"):
        correct_file(tmp_path / "none.ngc", out, off)
    with pytest.raises(StudyError, match="cannot be written"):
        correct_file(path, tmp_path / "none" / "out.ngc", off)
    before = out.read_bytes()
    path.write_bytes(b"G21\nG187\n")
    with pytest.raises(StudyError, match="G187"):
        correct_file(path, out, off)
    assert out.read_bytes() == before
    assert sorted(p.name for p in tmp_path.iterdir()) == ["corrected.ngc", "part.ngc"]


def test_a_compiled_displacement_is_traced_for_few_sizes():
    traced = []

    @jax.jit
    def compiled(positions, directions):
        traced.append(positions.shape)
        return 1e-4 * jnp.sin(20 * positions[:, ::-1]) + 2e-6 * directions

    rng = np.random.default_rng(5)
    for moves in (3, 40, 300):
        at = rng.uniform(0, 300, (moves, 3))
        text = HEAD + "".join("G1 X{:.3f} Y{:.3f} Z{:.3f} F100\n".format(*p) for p in at)
        lines_of(text, compiled)
    assert len(traced) == len(set(traced)) <= 3


def test_five_thousand_blocks():
    """Within 10 s of CPU on one core, which a surface of short lines takes; a tenth of it here."""
    rng = np.random.default_rng(1)
    at = 200 + np.cumsum(rng.normal(0, 0.5, (5000, 3)), 0)
    text = HEAD + "".join("X{:.4f} Y{:.4f} Z{:.4f}\n".format(*p) for p in at).replace(
        "X", "G1 X", 1
    )

    def bent(p, d):
        return np.stack([1e-5 * np.sin(30 * p[:, 1]), 5e-5 * p[:, 0], 1e-4 * p[:, 0] * p[:, 1]], 1)

    begun = time.process_time()
    _, report = lines_of(text, bent)
    assert time.process_time() - begun < 4.0
    assert report.corrected == 5000


def test_a_position_that_no_machine_has_is_refused():
    """2000 km would be a thousand million samples."""
    with pytest.raises(
        StudyError, match=r"line 3: found the axis position X = 2e\+09 mm, expected"
    ):
        lines_of(HEAD + "G1 X2000000000. F100\n")


@pytest.mark.parametrize("words", ["I1000000000. J0", "I10. J0 P100000"])
def test_arcs_without_end_are_left_alone(words):
    lines, report = lines_of(HEAD + f"G2 X0 Y0 {words} F100\n")
    assert report.left == 1 and any(words in line for line in lines)


def test_moves_beyond_the_calibrated_travels_are_reported():
    travels = ((0.0, 100.0), (0.0, 50.0), (0.0, 20.0))
    _, report = lines_of(HEAD + "G1 X99 F100\nX101\nZ-3\nX50 Z1\n", travels_mm=travels)
    (warning,) = report.warnings
    assert str(warning) == (
        "lines 4, 5: 2 moves up to line 5 beyond the calibrated travels (X 0 to 100 mm, Z 0 to "
        "20 mm), where errors are extrapolated"
    )
