"""Published campaigns done again: against closed forms, and the folder that they leave."""

import json
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from matplotlib.text import Text
from scipy.stats import maxwell, rayleigh
from typer.testing import CliRunner

import vcal.reproduce.tracker_verification.results as computing
from vcal.cli import app
from vcal.errors import StudyError
from vcal.identification.batch import prepare_batch
from vcal.model.forward import observe_all, tool_columns, tool_points_with_jacobian
from vcal.plots.panels import Panel, bars, mark, panels
from vcal.report import Table
from vcal.reproduce import REPRODUCTIONS, reproduction
from vcal.reproduce.document import Row, rows_table, section, table
from vcal.reproduce.registry import Computed, Reproduction, each, part
from vcal.reproduce.tracker_verification.compared import normal_length
from vcal.reproduce.tracker_verification.family import find_family, rank_of
from vcal.reproduce.tracker_verification.results import Probe, probing
from vcal.reproduce.tracker_verification.setting import (
    FINAL_UM,
    INITIAL_UM,
    STATION_MM,
    Family,
    Setting,
    machine,
    truth_and_fit,
)
from vcal.reproduce.tracker_verification.trials import Runner, measured_points

SMALL = Setting(grid=5, degrees=(1, 2))
FAMILY = Family(18.0, 95.0)
DRAWS, FEW = 600, 130


@pytest.fixture(scope="module")
def runners():
    return []


@pytest.fixture(scope="module")
def results(runners):
    def runner(*arguments):
        runners.append(Runner(*arguments))
        return runners[-1]

    steps = []
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(computing, "Runner", runner)
        patch.setattr(computing, "TESTS", FEW)
        found = computing.Results(DRAWS, 3, steps.append, SMALL)
        assert not steps and not runners
        every = [dict(one) for one in (found.few, found.many, found.rungs, found.influences)]
        assert all(every) and found.rank and found.probing
    assert len(steps) == len(set(steps)) > 10
    return found


def first(table):
    return next(iter(table.values()))


def covariance_of_points(family):
    """Covariance (n, 3, 3) of the initial error, linear in the errors, m^2."""
    model = machine(SMALL, family)
    ports = jnp.zeros((SMALL.grid**2, len(model.layout)))
    _, by_port = tool_points_with_jacobian(model.chain, jnp.asarray(SMALL.positions), ports)
    terms = model.terms(SMALL.plan)
    columns = np.asarray(by_port)[:, :, terms.port] * np.asarray(terms.values)[:, None, :]
    # Several terms of one parameter move together.
    total = np.zeros((*columns.shape[:2], len(model.entries)))
    np.add.at(total.transpose(2, 0, 1), np.asarray(terms.parameter), columns.transpose(2, 0, 1))
    return np.einsum("nik,njk->nij", total, total)


# --- what is drawn ---


@pytest.mark.thorough
def test_the_family_has_the_printed_mean_and_spread():
    search = find_family(SMALL, *INITIAL_UM, machines=4000)
    assert search.mean_um == pytest.approx(INITIAL_UM[0], abs=1e-3)
    assert search.sd_um == pytest.approx(INITIAL_UM[1], abs=1e-2)
    lengths = [normal_length(c) for c in 1e12 * covariance_of_points(search.family)]
    mean = np.mean([m for m, _ in lengths])
    square = np.mean([m**2 + s**2 for m, s in lengths])
    # 4000 machines, whose points are nearly one: about 0.7 %.
    assert mean == pytest.approx(INITIAL_UM[0], rel=0.025)
    assert np.sqrt(square - mean**2) == pytest.approx(INITIAL_UM[1], rel=0.05)


@pytest.mark.thorough
def test_a_spread_that_no_family_has_is_refused():
    with pytest.raises(ValueError, match=r"found a spread of 1\.500 of the mean, expected one"):
        find_family(SMALL, 10.0, 15.0, machines=200)


@pytest.mark.thorough
def test_at_z_zero_the_points_see_no_rotation_of_y_and_z():
    rank = rank_of(SMALL, FAMILY)
    silent = {m.name for m in rank.motions if m.silent == m.coefficients}
    assert silent == {f"E{c}{axis}" for c in "ABC" for axis in "YZ"} | {"EB0Z", "EA0Z"}
    assert rank.silent == 6 * 2 + 2
    # Polynomials of the positions with these degrees: an own basis for the same tool points.
    n = SMALL.grid**2
    jacobian = np.asarray(prepare_batch(machine(SMALL, FAMILY), SMALL.plan).jacobian)
    assert rank.rank == np.linalg.matrix_rank(jacobian, tol=1e-6) < rank.parameters
    assert jacobian.shape == (3 * n, rank.parameters)
    x, y = SMALL.positions[:, 0], SMALL.positions[:, 1]
    one = np.ones(n)
    # dX: EXX + EXY + ECX y + constant; dY: ECX x; dZ: EAX y + EBX x.
    rows = {
        "X": [x, x**2, y, y**2, one], "Y": [x, x**2, y, y**2, one], "Z": [x, x**2, y, y**2, one]
    }  # fmt: skip
    u = (2 * x - 0.4) / 0.4
    legendre = [u, 1.5 * u**2 - 0.5]
    columns = []
    for own, functions in rows.items():
        for f in functions:
            columns.append(np.concatenate([f * (own == c) for c in "XYZ"]))
    for f in legendre:
        columns.append(np.concatenate([-f * y, f * x, 0 * x]))
        columns.append(np.concatenate([0 * x, 0 * x, f * y]))
        columns.append(np.concatenate([0 * x, 0 * x, f * x]))
    assert rank.rank == np.linalg.matrix_rank(np.stack(columns, 1), tol=1e-9)


@pytest.mark.thorough
def test_points_measured_are_the_points():
    truth, _ = truth_and_fit(SMALL, FAMILY)
    still = jnp.zeros((SMALL.grid**2, len(truth.layout)))
    readings = observe_all(truth.chain, truth.instrument, jnp.asarray(SMALL.positions), (), still)
    away = np.linalg.norm(SMALL.positions - np.array(STATION_MM) / 1e3, axis=1)
    np.testing.assert_allclose(readings[:, 0], away, atol=1e-14)
    np.testing.assert_allclose(
        measured_points(truth.instrument, readings), SMALL.positions, atol=1e-14
    )


# --- tests ---


@pytest.mark.campaign
def test_the_residual_is_what_linear_theory_says(results):
    # Readings have the covariance S + J P J'; the posterior mean leaves S (S + J P J')^-1 of them.
    trials = first(results.many)
    batch = trials.pair.batch
    jacobian = np.asarray(batch.jacobian)
    left = np.linalg.inv(np.eye(len(jacobian)) + jacobian @ jacobian.T)
    sigma = np.asarray(trials.pair.simulator.sigma)
    tracker = trials.pair.truth.instrument
    length = tracker.lengths(trials.pair.batch.plan, np.asarray(batch.nominal))
    squares = 1e12 * np.diag(left).reshape(sigma.shape) * (sigma * length) ** 2
    p = trials.pooled["residual", "distance"]
    assert np.hypot(p.mean, p.sd) == pytest.approx(np.sqrt(squares.sum(1).mean()), rel=0.01)


@pytest.mark.campaign
def test_the_tracker_explains_the_printed_residual_only_as_three_sigma(results):
    means = {k: t.pooled["residual", "distance"].mean for k, t in results.many.items()}
    assert means["24 µrad = 3 σ"] == pytest.approx(FINAL_UM[0], rel=0.1)
    assert means["24 µrad = 1 σ"] > 2.0 * FINAL_UM[0]


@pytest.mark.thorough
def test_initial_errors_come_out_as_printed(results):
    p = first(results.many).pooled["initial", "distance"]
    assert abs(p.mean - INITIAL_UM[0]) < 4.0 * p.u_mean
    assert p.sd == pytest.approx(INITIAL_UM[1], rel=0.1)
    assert p.share.sum() == pytest.approx(1.0, abs=2e-3)
    middles = 0.5 * (p.edges[1:] + p.edges[:-1])
    assert (p.share * middles).sum() == pytest.approx(p.mean, rel=0.01)
    assert 0.0 < p.quantile(0.5) < p.quantile(0.95) < p.edges[-1]


@pytest.mark.campaign
def test_more_tests_begin_with_the_same_ones(results):
    for name, trials in results.few.items():
        few, many = trials.ensemble.values, results.many[name].ensemble.values
        assert len(few) == FEW
        np.testing.assert_array_equal(few, many[:FEW])


@pytest.mark.thorough
def test_all_campaigns_are_one_program(results, runners):
    (runner,) = runners
    (program,) = runner.programs.values()
    assert program._cache_size() == 1


@pytest.mark.thorough
def test_every_identification_converged(results):
    for trials in (*results.many.values(), *results.influences.values()):
        assert trials.failed == 0
        assert np.isfinite(trials.ensemble.mean).all()


# --- the GUM ---


@pytest.mark.parametrize("sigma", [1.0, 3e-3])
def test_mean_length_of_a_normal_vector(sigma):
    for size, exact in ((3, maxwell), (2, rayleigh)):
        variances = sigma**2 * (np.arange(3) < size)
        mean, sd = normal_length(np.diag(variances))
        assert mean == pytest.approx(exact.mean(scale=sigma), rel=1e-8)
        assert sd == pytest.approx(exact.std(scale=sigma), rel=1e-7)
    mean, _ = normal_length(np.diag([sigma**2, 0.0, 0.0]))
    assert mean == pytest.approx(sigma * np.sqrt(2.0 / np.pi), rel=1e-8)
    with pytest.raises(ValueError, match="covariance of zero"):
        normal_length(np.zeros((3, 3)))


def test_mean_length_of_a_skewed_covariance():
    root = np.array([[2.0, 0.0, 0.0], [1.0, 0.5, 0.0], [-0.4, 0.3, 0.1]])
    drawn = np.random.default_rng(0).standard_normal((400_000, 3)) @ root.T
    size = np.linalg.norm(drawn, axis=1)
    mean, sd = normal_length(root @ root.T)
    assert mean == pytest.approx(size.mean(), rel=4e-3)
    assert sd == pytest.approx(size.std(), rel=4e-3)


@pytest.mark.thorough
def test_gum_and_monte_carlo_agree_whatever_the_noise(results):
    scatter = 1.0 / np.sqrt(2.0 * DRAWS)
    for name, one in list(results.rungs.items())[:3]:
        for c in one.both:
            assert np.abs(c.u[:, 1] / c.u[:, 0] - 1.0).max() < 4.5 * scatter, name
            assert (np.abs(c.value[:, 1]) / c.u[:, 1]).max() < 4.5 / np.sqrt(DRAWS), name
            assert "failed" not in c.verdicts
        for length in one.lengths:
            assert length.mean[1] == pytest.approx(length.mean[0], rel=0.1)


@pytest.mark.thorough
def test_the_gum_has_nothing_for_lengths(results):
    one = first(results.rungs)
    assert set(one.undefined) == {length.label for length in one.lengths}
    assert all(label.startswith("|d| at (") for label in one.undefined)


@pytest.mark.thorough
def test_error_left_is_the_posterior(results):
    # cov(d) = G H^-1 G' with G = dd/dtheta: by finite differences of the exact tool points.
    one = first(results.rungs)
    pair, points = one.trials.pair, one.trials.points
    k = len(pair.fit.entries)
    inverse = np.asarray(pair.batch.inverse)

    @jax.jit
    def predicted(theta):
        ports = points.found(theta, {})
        return jnp.stack(tool_columns(points.chain, points.position, ports), -1).reshape(-1)

    slopes = np.stack([(predicted(s) - predicted(-s)) / 2e-3 for s in 1e-3 * np.eye(k)], 1)
    u = 1e6 * np.sqrt(np.einsum("ik,kl,il->i", slopes, inverse, slopes)).reshape(-1, 3)
    named = u[list(points.named)].reshape(-1)
    np.testing.assert_allclose(one.components.u[:, 0], named, rtol=1e-5)


# --- influences and probing ---


@pytest.mark.thorough
def test_what_is_left_out_makes_it_worse(results):
    left = {k: t.pooled["left", "distance"].mean for k, t in results.influences.items()}
    alone, *others = left.values()
    assert min(others) > alone
    assert left["and pose, fitted"] < left["and tracker's pose"]
    aligned = {k: t.pooled["aligned", "distance"].mean for k, t in results.influences.items()}
    assert aligned["and tracker's pose"] == pytest.approx(aligned["tracker noise alone"], rel=0.02)


@pytest.mark.thorough
def test_probing_adds_what_is_independent(results):
    trials = first(results.many)
    bare, real = probing(trials, Probe(0.0, 0.0)), probing(trials, Probe(3.0, 4.0))
    np.testing.assert_allclose(bare.u, bare.u_machine)
    np.testing.assert_allclose(real.u**2 - bare.u**2, 25.0)
    for a, b in zip(bare.lengths, real.lengths, strict=True):
        assert b.u**2 - a.u**2 == pytest.approx(50.0)
    # Along X, from the draws themselves.
    values = trials.ensemble.values
    labels = trials.ensemble.labels
    ends = [values[:, labels.index(f"dX at ({x}, 0) mm [um]")] for x in (0, 400)]
    assert bare.lengths[0].u == pytest.approx(np.std(ends[1] - ends[0], ddof=1), rel=1e-9)


# --- the folder and the command ---


@pytest.mark.parametrize("longest", [0, 2, 4])
def test_no_bar_is_behind_the_legend(longest):
    sizes = {f"influence {i}": 20.0 if i == longest else 1.0 for i in range(5)}
    series = {"as it is": sizes, "after rigid alignment": dict.fromkeys(sizes, 0.5)}
    marks = bars(series, horizontal=True)
    drawn = panels([Panel("Mean error", "µm", "", marks, "right")], width=9.0, height=4.0)
    drawn.draw_without_rendering()
    (ax,) = drawn.axes
    legend = ax.get_legend().get_window_extent()
    titles = [t for t in ax.get_children() if isinstance(t, Text) and t.get_text()]
    assert not any(legend.overlaps(bar.get_window_extent()) for bar in ax.patches)
    assert titles and not any(legend.overlaps(t.get_window_extent()) for t in titles)
    assert legend.x1 <= drawn.bbox.x1 and legend.y1 <= drawn.bbox.y1
    names = [label.get_window_extent() for label in ax.get_yticklabels()]
    assert min(name.x0 for name in names) >= drawn.bbox.x0
    lengths = {bar.get_label(): [b.get_width() for b in bar] for bar in ax.containers}
    assert lengths["as it is"] == list(sizes.values())


def test_a_text_becomes_sections():
    figure = panels([Panel(marks=[mark("plot", [0, 1], [0, 1])])], width=2.0, height=2.0)
    one = table("error | u | share", [("EXX", 1.23456, "10 %"), ("EYX", None, "–")], fold="All")
    text = """\
One
paragraph.

Another one.
- a point
over two lines
:numbers in µm
:curve what it shows
~ small print
"""
    shown = {"numbers": one, "curve": figure}.__getitem__
    first, second = section("First", text, shown), section("Second", "", shown)
    assert (first.title, second.title, second.paragraphs) == ("First", "Second", ())
    assert first.paragraphs == ("One paragraph.", "Another one.")
    assert first.points == ("a point over two lines",) and first.note == "small print"
    (numbers,) = first.tables
    assert numbers == Table(
        ("error", "u", "share"), [["EXX", "1.23", "10 %"], ["EYX", "–", "–"]], "lrr", "in µm", "All"
    )
    (picture,) = first.pictures
    assert (picture.name, picture.caption) == ("curve", "what it shows")
    with pytest.raises(KeyError, match="surface"):
        section("First", ":surface", shown)


def test_a_notebook_shows_results_and_single_sections():
    campaign = Reproduction(
        name="little",
        summary="",
        title="Little",
        publication="Author (2000)",
        compute=lambda draws, seed, progress, size=1.0: size * (draws + seed),
        rows=lambda value: [Row("sum", 3.5, value, "um")],
        record=lambda value: {"sum": np.float64(value)},
        head=lambda value: (f"Sum\n{value:g}.", []),
        texts={"All": lambda value: ":numbers", "Rest": lambda value: "None."},
        shown={"half": lambda value: table("half", [(0.5 * value,)])},
        counted="draws",
        draws=5,
        least=2,
    )
    result = campaign.results(4, 1, size=0.5)
    assert result.values == 2.5 and campaign.results().values == 5.0
    section = result.section("All")._repr_html_()
    assert '<td>sum</td><td class="n">3.5</td><td class="n">2.500</td>' in section
    assert "<h2" not in rows_table(result.rows)._repr_html_()
    half = result.show("half")._repr_html_()
    assert "1.25" in half and "<h2" not in half and "<td>sum" not in half
    assert "Rest" not in section and "Rest" in result._repr_html_()
    record = result.record()
    row = {"quantity": "sum", "seed": 3.5, "vcal": 2.5, "unit": "um", "note": ""}
    assert record["table"] == [row] and record["sum"] == 2.5
    assert (record["draws"], record["seed"]) == (4, 1)
    assert "Sum 2.5." in result.html()
    for wrong in (result.section, result.show):
        with pytest.raises(KeyError, match="Nothing"):
            wrong("Nothing")
    with pytest.raises(StudyError, match="found draws = 1, seed = 0, expected at least 2 draws"):
        campaign.results(1)


def test_results_are_computed_once_and_when_they_are_asked_for():
    class Squares(Computed):
        @part("the sum")
        def total(self):
            return sum(self.squares.values())

        @each("the square of {}", (1, 2, 3))
        def squares(self, number):
            return self.draws * number**2

    said = []
    found = Squares(10, progress=said.append)
    assert found.squares[2] == 40 and said == ["the square of 2"]
    assert found.total == 140 == found.total and list(found.squares) == [1, 2, 3]
    assert said[1:] == ["the sum", "the square of 1", "the square of 3"]
    with pytest.raises(KeyError, match="4"):
        found.squares[4]


def test_printed_numbers_are_shown_as_printed():
    rows = [Row("cycles", 30_000.0, 200.0, "1"), Row("EXZ", -1.55, -1.6766, "um s2/m", "note")]
    cells = [list(row[1:4]) for row in rows_table(rows).rows]
    assert cells == [["30000", "200", ""], ["−1.55", "−1.677", "µm s²/m"]]


@pytest.mark.thorough
def test_the_folder(results, tmp_path):
    asked = []
    campaign = replace(
        reproduction("tracker-verification"),
        compute=lambda draws, seed, progress: asked.append((draws, seed)) or results,
    )
    out = tmp_path / "out"
    page = campaign.run(out, DRAWS, 3, lambda step: None)
    assert asked == [(DRAWS, 3)]
    assert page == out / "index.html"
    record = json.loads((out / "result.json").read_text(encoding="utf-8"))
    assert record["name"] == "tracker-verification" and record["draws"] == DRAWS
    assert {p.name for p in out.iterdir()} == set(record["files"])
    for row in record["table"]:
        assert list(row) == ["quantity", "seed", "vcal", "unit", "note"]
        assert isinstance(row["vcal"], float)
    printed = {row["quantity"]: row["seed"] for row in record["table"]}
    assert printed["final error, mean of |d|"] == 12.34
    assert printed["initial error, standard deviation of |d|"] == 40.91
    text = page.read_text(encoding="utf-8")
    assert "nan" not in text.split("<main>")[1].split("data:image")[0]
    assert text.count("<figure") == 8
    for name in record["files"]:
        if name.endswith(".png"):
            assert (out / name).read_bytes().startswith(b"\x89PNG")
    # Again into the same folder, but not into one with other things in it.
    assert campaign.run(out, DRAWS, 3, print) == page
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "mine.txt").write_text("mine")
    with pytest.raises(StudyError, match=r"output folder: found other files \(mine.txt"):
        campaign.run(tmp_path / "other", DRAWS, 3, print)


def refused(*arguments):
    result = CliRunner().invoke(app, [str(a) for a in arguments])
    assert result.exit_code == 2, result.output
    assert result.stdout == ""
    return result.stderr


def test_the_command(tmp_path, monkeypatch):
    monkeypatch.setenv("VCAL_NO_CACHE", "1")
    listed = CliRunner().invoke(app, ["reproduce"])
    assert listed.exit_code == 0
    assert all(name in listed.stdout for name in REPRODUCTIONS)
    out = tmp_path / "out"
    wrong = refused("reproduce", "tracker-verificatoin", "--out", out)
    assert (
        "found 'tracker-verificatoin', expected one of acceleration, artefact-design, laser-frame, "
        "tracker-verification" in wrong
    )
    assert "did you mean 'tracker-verification'?" in wrong
    assert "--out: found none" in refused("reproduce", "tracker-verification")
    few = refused("reproduce", "tracker-verification", "--out", out, "--draws", "20")
    assert "found draws = 20, seed = 0, expected at least 200 draws" in few
    (tmp_path / "file").write_text("")
    taken = refused("reproduce", "tracker-verification", "--out", tmp_path / "file")
    assert "output folder: found a file" in taken
    assert not out.exists()
