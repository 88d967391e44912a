"""What a budget gives: joint degrees of freedom, tables, files, required uncertainties, sweeps."""

import json
import math
import re

import jax.numpy as jnp
import jsonschema
import numpy as np
import pytest
from scipy import stats

from vcal.distributions import Inputs, MultivariateNormal, Normal, Repeats, StudentT, Uniform
from vcal.errors import StudyError
from vcal.plots import sweep_view
from vcal.uncertainty import (
    budget_table,
    compare,
    joint_outputs,
    load_budget,
    propagate,
    propagate_distributions,
    required_u,
    result_line,
    save_budget,
    saved,
    sweep,
)

INPUTS = Inputs(
    {
        "a": StudentT(2.0, 0.3, 4),
        "b": Normal(5.0, 0.2),
        "c": Uniform(-1.0, 1.0),
        "d": Normal(1.0, 0.1),
    },
    {("b", "d"): -0.4},
)


def product(v):
    return v["a"] * v["b"] + v["c"] + v["d"]


def vector(v):
    return {"S": v["a"] * jnp.exp(1j * v["b"]) + v["c"], "m": v["d"] * v["a"]}


@pytest.fixture(scope="module")
def budget():
    return propagate(product, INPUTS)


@pytest.fixture(scope="module")
def several():
    return propagate(vector, INPUTS)


# --- several outputs, complex ones ---


def test_complex_outputs_are_two_real_ones(several):
    assert several.labels == ("S.re", "S.im", "m")
    assert several.value[:2] == pytest.approx([2 * math.cos(5), 2 * math.sin(5)])
    assert several.sensitivity[0, :3] == pytest.approx([math.cos(5), -2 * math.sin(5), 1.0])
    drawn = propagate_distributions(vector, INPUTS, draws=2000)
    assert drawn.labels == several.labels


def test_joint_degrees_of_freedom_of_one_output_are_welch_and_satterthwaite(budget, several):
    assert joint_outputs(budget).dof == pytest.approx(budget.nu_eff[0], rel=1e-12)
    assert joint_outputs(budget, weighting="invariant").dof == pytest.approx(budget.nu_eff[0])
    assert joint_outputs(several, ["m"]).dof == pytest.approx(several.nu_eff[2], rel=1e-12)


def test_joint_degrees_of_freedom_of_one_group_are_its_own():
    inputs = Inputs({"x": MultivariateNormal([1.0, 2.0], [[0.04, 0.01], [0.01, 0.09]], dof=4)})
    budget = propagate(lambda v: {"u": v["x"][0] * v["x"][1], "w": v["x"][0]}, inputs)
    for weighting in ("elements", "invariant"):
        assert joint_outputs(budget, weighting=weighting).dof == pytest.approx(4.0, rel=1e-9)


def test_joint_degrees_of_freedom_match_the_scatter_of_covariance_matrices():
    """Sum of Wishart matrices: the variances of the elements of V, against simulation."""
    dofs, mixing = (5, 9), (np.array([[1.0, 0.0], [0.6, 0.5]]), np.array([[0.7, 0.2], [0.0, 1.1]]))
    found = np.zeros((20_000, 2, 2))
    for seed, (nu, root) in enumerate(zip(dofs, mixing, strict=True)):
        draws = np.random.default_rng(seed).standard_normal((20_000, nu, 2)) @ root.T
        found += np.einsum("nki,nkj->nij", draws, draws) / nu
    v = sum(root @ root.T for root in mixing)
    scatter = sum(found[:, i, j].var() for i, j in ((0, 0), (0, 1), (1, 1)))
    own = 2 * v[0, 0] ** 2 + 2 * v[1, 1] ** 2 + v[0, 0] * v[1, 1] + v[0, 1] ** 2
    inputs = Inputs(
        {
            name: MultivariateNormal([0.0, 0.0], root @ root.T, dof=nu)
            for name, nu, root in zip("pq", dofs, mixing, strict=True)
        }
    )
    budget = propagate(lambda v: v["p"] + v["q"], inputs)
    assert joint_outputs(budget).dof == pytest.approx(own / scatter, rel=0.03)
    # A change of units does not change the invariant form.
    other = propagate(lambda v: (v["p"] + v["q"]) * jnp.array([1.0, 1e3]), inputs)
    invariant = [joint_outputs(one, weighting="invariant").dof for one in (budget, other)]
    assert invariant[0] == pytest.approx(invariant[1], rel=1e-9)


def test_region_of_a_complex_output(several):
    found = joint_outputs(several, "S")
    assert found.labels == ("S.re", "S.im")
    nu = found.dof
    square = 2 * nu / (nu - 1) * stats.f.ppf(0.95, 2, nu - 1)
    assert found.region.factor == pytest.approx(math.sqrt(square), rel=1e-9)
    for outputs, message in ((["m", "m"], "found 'm' twice"), ("n", "found 'n', expected one of")):
        with pytest.raises(ValueError, match=message):
            joint_outputs(several, outputs)
    with pytest.raises(ValueError, match="weighting: found 'none'"):
        joint_outputs(several, weighting="none")
    flat = propagate(lambda v: {"p": v["a"], "q": 2.0 * v["a"]}, INPUTS)
    with pytest.raises(ValueError, match="p, q depend on each other"):
        joint_outputs(flat, weighting="invariant")


# --- shape of Monte Carlo outputs ---


def test_skewness_and_kurtosis_of_draws():
    drawn = propagate_distributions(
        lambda v: {"x": v["b"], "square": (v["b"] - 5.0) ** 2, "fixed": 0.0 * v["b"] + 3.0},
        INPUTS,
        draws=40_000,
    )
    for i, label in enumerate(("x", "square")):
        values = drawn.values[:, drawn.index(label)]
        assert drawn.skewness[i] == pytest.approx(stats.skew(values), rel=1e-9)
        assert drawn.excess_kurtosis[i] == pytest.approx(stats.kurtosis(values), rel=1e-8)
    assert drawn.skewness[1] == pytest.approx(math.sqrt(8), rel=0.1)
    assert abs(drawn.skewness[0]) < 0.06 and np.isnan(drawn.skewness[2])


# --- k, digits and layouts ---


def test_stated_k_and_degrees_of_freedom(budget):
    two = budget.stated(k=2)
    assert two.U[0] == pytest.approx(2 * budget.u[0], rel=1e-15)
    assert "k = 2 (stated), U = " in result_line(two) and "%" not in result_line(two)
    fifty = budget.stated(nu_eff=50, coverage=0.99)
    assert fifty.k[0] == pytest.approx(stats.t.ppf(0.995, 50), rel=1e-9)
    assert "ν_eff = 50 (stated)" in result_line(fifty)
    assert budget.stated_k is None  # unchanged
    with pytest.raises(ValueError, match="which has no coverage probability"):
        compare(two, propagate_distributions(product, INPUTS, draws=1000))
    for settings, message in (
        ({}, "found nothing"),
        ({"k": 2, "nu_eff": 5}, "found k with nu_eff or coverage"),
        ({"k": -1}, "found k = -1"),
        ({"coverage": 2}, "coverage probability: found 2"),
    ):
        with pytest.raises(ValueError, match=message):
            budget.stated(**settings)


def test_digits_of_u_and_the_value_to_match():
    budget = propagate(lambda v: v["x"], Inputs({"x": Normal(12.3456789, 0.0123456)}))
    for digits, shown in {
        1: "y = 12.35, u = 0.01",
        2: "y = 12.346, u = 0.012",
        4: "y = 12.34568, u = 0.01235",
    }.items():
        assert result_line(budget, digits=digits).startswith(shown + ",")
    with pytest.raises(ValueError, match="digits: found 0"):
        budget_table(budget, digits=0)


def test_layouts_have_the_same_cells(budget):
    markdown, below = budget_table(budget).split("\n\n")
    rows = [[c.strip() for c in line.strip("|").split("|")] for line in markdown.splitlines()]
    rows.pop(1)
    latex = budget_table(budget, layout="latex")
    assert latex.count(r"\hline") == 3 and r"\begin{tabular}{lrrlrrrr}" in latex
    for symbol, written in ((r"\%", "%"), (r"$\infty$", "∞"), ("$-$", "−")):
        latex = latex.replace(symbol, written)
    lines = [line.removesuffix(r"\\") for line in latex.splitlines() if line.endswith(r"\\")]
    assert [[c.strip() for c in line.split("&")] for line in lines] == rows
    html = budget_table(budget, layout="html")
    found = [re.findall(r"<t[hd][^>]*>([^<]*)</t[hd]>", row) for row in html.split("<tr>")[1:]]
    assert found == rows and f"<p>{below}</p>" in html
    plain, line = budget_table(budget, layout="plain").split("\n\n")
    heads, rule, *others = plain.splitlines()
    assert [re.split(r" {2,}", row.strip()) for row in (heads, *others[:4])] == rows[:5]
    assert set(rule) == {"-", " "} and line == below
    with pytest.raises(ValueError, match="layout: found 'word', expected one of 'markdown'"):
        budget_table(budget, layout="word")


def test_names_are_escaped():
    budget = propagate(lambda v: v["d_x<50%"], Inputs({"d_x<50%": Normal(-1.0, 0.1)}))
    assert r"d\_x<50\% & $-$1.00" in budget_table(budget, layout="latex")
    assert r"$\nu_\mathrm{eff}$ = $\infty$" in budget_table(budget, layout="latex")
    assert "<td>d_x&lt;50%</td>" in budget_table(budget, layout="html")


# --- files ---


@pytest.mark.parametrize("order", [1, 2])
def test_saved_budgets_come_back_as_they_were(tmp_path, order):
    budget = propagate(vector, INPUTS, order=order, coverage=0.9).stated(nu_eff=12)
    save_budget(budget, tmp_path / "a.json")
    save_budget(load_budget(tmp_path / "a.json"), tmp_path / "b.json")
    assert (tmp_path / "a.json").read_bytes() == (tmp_path / "b.json").read_bytes()
    back = load_budget(tmp_path / "b.json")
    for name in ("value", "u", "nu_eff", "sensitivity", "covariance", "U", "share"):
        np.testing.assert_array_equal(getattr(back, name), getattr(budget, name))
    assert (back.labels, back.notes, back.coverage) == (budget.labels, budget.notes, 0.9)
    assert budget_table(back, "m") == budget_table(budget, "m")
    content = json.loads((tmp_path / "a.json").read_text())
    schema = json.loads((saved.SCHEMA).read_text())
    jsonschema.validate(content, schema)
    again = propagate(vector, INPUTS, order=order, coverage=0.9).stated(nu_eff=12)
    save_budget(again, tmp_path / "c.json")
    assert (tmp_path / "c.json").read_bytes() == (tmp_path / "a.json").read_bytes()


def test_files_that_are_no_budget(tmp_path, budget):
    file = tmp_path / "budget.json"
    save_budget(budget, file)
    good = json.loads(file.read_text())

    def changed(**keys):
        return json.dumps(good | keys)

    missing = {k: v for k, v in good.items() if k != "u"}
    for text, message in (
        ("{", "found no JSON"),
        ("[]", "schema: found None, expected the name 'vcal uncertainty budget'"),
        (changed(schema=good["schema"] | {"version": 9}), "found version 9, expected 1"),
        (json.dumps(missing), "u is missing"),
        (changed(u=[1.0, 2.0]), r"u: found shape \(2,\), expected \(1,\)"),
        (changed(u=["a"]), "u: found something other than numbers"),
        (changed(u=[budget.u[0] * 1.01]), "u of 'y' gives a standard uncertainty of .* changed"),
        (changed(sensitivity=[[1.0, 1.0, 1.0, 1.0]]), "sensitivity of 'y' gives"),
        (changed(outputs="y"), "outputs: found 'y', expected a list of texts"),
        (changed(coverage="high"), "coverage: found 'high', expected a number"),
        (changed(inputs=[]), "inputs.: found list, expected an object"),
        (changed(inputs=good["inputs"] | {"groups": [[9]]}), "inputs.groups: found"),
    ):
        file.write_text(text)
        with pytest.raises(StudyError, match=message):
            load_budget(file)
    with pytest.raises(StudyError, match=r"none\.json: cannot be read"):
        load_budget(tmp_path / "none.json")


# --- required uncertainties and sweeps ---


def again(**u):
    """u and U of the output with other standard uncertainties of some inputs."""
    plain = {"b": Normal(5.0, u.get("b", 0.2)), "a": StudentT(2.0, u.get("a", 0.3), 4)}
    inputs = INPUTS
    for name, d in plain.items():
        inputs = inputs.replaced(name, d)
    found = propagate(product, inputs)
    return found.u[0], found.U[0]


@pytest.mark.parametrize("name", ["a", "b"])
def test_required_u_gives_the_wanted_one(budget, name):
    wanted = 0.9 * budget.u[0] if name == "a" else 1.2 * budget.u[0]
    found = required_u(budget, name, u=wanted)
    assert again(**{name: found.u})[0] == pytest.approx(wanted, rel=1e-9)
    assert found.u == pytest.approx(found.factor * float(INPUTS.std[1] if name == "b" else 0.3))
    U = (0.8 if name == "a" else 1.1) * budget.U[0]
    expanded = required_u(budget, name, U=U)
    assert again(**{name: expanded.u})[1] <= U * (1 + 1e-9)
    assert again(**{name: 1.001 * expanded.u})[1] > U


def test_required_u_that_cannot_be(budget, several):
    with pytest.raises(ValueError, match="is left with an exact b; reduce another input too"):
        required_u(budget, "b", u=0.5)
    with pytest.raises(ValueError, match="found U = 0.5 wanted"):
        required_u(budget, "b", U=0.5)
    for arguments, message in (
        ({"input": "e", "u": 1.0}, "input: found 'e', expected one of a, b, c, d"),
        ({"input": "a"}, "found u = None and U = None, expected one"),
        ({"input": "a", "u": 1.0, "U": 1.0}, "expected one of the two"),
    ):
        with pytest.raises(ValueError, match=message):
            required_u(budget, **arguments)
    with pytest.raises(ValueError, match="has 3 outputs; name the one"):
        required_u(several, "a", u=0.1)
    with pytest.raises(ValueError, match="m does not depend on it"):
        required_u(several, "c", u=1.0, output="m")
    with pytest.raises(ValueError, match="of second order"):
        required_u(propagate(product, INPUTS, order=2), "a", u=1.0)


def test_sweep_over_u_and_over_the_value(budget):
    u = np.array([0.1, 0.2, 0.4])
    found = sweep(product, INPUTS, "b", u=u)
    assert found.u[:, 0] == pytest.approx([again(b=one)[0] for one in u], rel=1e-9)
    assert found.U[1, 0] == pytest.approx(budget.U[0]) and found.value[0] == budget.value
    place = INPUTS.labels.index("b")
    assert found.share[1, 0] == pytest.approx(budget.share[0, place])
    values = np.array([2.0, 5.0, 9.0])
    moved = sweep(product, INPUTS, "b", value=values)
    assert moved.value[:, 0] == pytest.approx(2.0 * values + 1.0)
    assert moved.u[1, 0] == pytest.approx(budget.u[0], rel=1e-12)
    second = sweep(lambda v: (v["b"] - 5.0) ** 2, INPUTS, "b", u=u, order=2)
    assert second.u[:, 0] == pytest.approx(math.sqrt(2) * u**2, rel=1e-9)


def test_sweep_as_a_picture(budget):
    found = sweep(product, INPUTS, "b", u=[0.1, 0.2, 0.4])
    drawn = sweep_view(found, wanted=1.8, unit="um", input_unit="mm")
    left, right = drawn.axes
    line = right.lines[0]
    np.testing.assert_array_equal(line.get_xdata(), found.at)
    np.testing.assert_array_equal(line.get_ydata(), found.u[:, 0])
    assert right.lines[1].get_ydata()[0] == 1.8
    assert [text.get_text() for text in right.get_legend().get_texts()] == ["wanted"]
    assert left.get_xlabel() == "u(b) / mm" and right.get_title(loc="left") == "u(y)"
    band = left.collections[0].get_paths()[0].get_extents()
    assert band.y1 == pytest.approx((found.value + found.U).max())


def test_sweeps_that_cannot_be():
    array = Inputs({"x": MultivariateNormal([0.0], [[1.0]]), "r": Repeats([1.0, 2.0])})
    for inputs, name, settings, message in (
        (INPUTS, "e", {"u": [1.0]}, "sweep: found input 'e'"),
        (INPUTS, "a", {}, "expected one of value and u"),
        (INPUTS, "a", {"u": 1.0}, r"found u of shape \(\), expected a list"),
        (INPUTS, "a", {"u": [0.0]}, "u: found 0.0, expected a finite number above 0"),
        (array, "x", {"u": [1.0]}, "x is multivariate"),
    ):
        with pytest.raises(ValueError, match=message):
            sweep(lambda v: v["r"], inputs, name, **settings)
    found = sweep(vector, INPUTS, "c", u=[0.1, 0.2])
    with pytest.raises(ValueError, match="has 3 outputs; name the one to draw"):
        sweep_view(found)
    with pytest.raises(ValueError, match="output: found 'M'"):
        sweep_view(found, "M")
