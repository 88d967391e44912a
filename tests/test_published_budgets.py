"""Published evaluations (`_site.published_examples`): GUM and Monte Carlo give what is printed."""

import math

import pytest
from scipy import stats

from _site.published_examples import EXAMPLES, Published
from vcal.distributions import Inputs, Normal
from vcal.uncertainty import propagate, propagate_distributions, result_line

EACH = pytest.mark.parametrize(
    "one", [pytest.param(e, id=f"{e.source}, {e.subject}") for e in EXAMPLES]
)
NAMED = {e.source: e for e in EXAMPLES}


@EACH
def test_the_gum_gives_what_is_printed(one: Published):
    budget = one.budget()
    for p in one.printed:
        if p.gum:
            assert one.by_gum(p, budget) == pytest.approx(float(p.text), abs=p.allowed), p
    found = dict(zip(budget.source.labels, one.per * budget.contribution[0], strict=True))
    for name, text in one.contributions.items():
        half = 0.5 * 10.0 ** -len(text.partition(".")[2]) if one.within is None else one.within
        assert found[name] == pytest.approx(float(text), abs=half), name


@pytest.mark.slow
@EACH
def test_monte_carlo_gives_what_is_printed(one: Published):
    ensemble = one.ensemble()
    s = ensemble.precision()
    for p in one.printed:
        i = ensemble.index(p.output)
        error = {"y": s.y[i], "u": s.u[i], "k": 0.01}.get(p.what, math.hypot(s.low[i], s.high[i]))
        if p.monte_carlo:
            margin = p.allowed + 4.0 * float(error) * (1.0 if p.what == "k" else p.factor)
            assert one.by_draws(p, ensemble) == pytest.approx(float(p.text), abs=margin), p


@pytest.mark.thorough
def test_the_table_shows_every_printed_result():
    pytest.importorskip("sphinx", reason="the extra docs has it")
    from _site.published import published

    shown = published()
    for one in EXAMPLES:
        assert one.source in shown and one.subject in shown
        assert all(p.text.replace("-", "−") in shown for p in one.printed)


@pytest.mark.parametrize(
    "subject, y, u, apart",
    [
        ("furnace", 1000.5, 0.640870516811861, 1e-12),
        ("power sensor", 0.933024133333333, 0.0161763656260788, 4e-3),
        ("attenuator", 30.04325, 0.0224185377162145, 1e-3),
    ],
)
def test_results_of_public_files_to_their_digits(subject, y, u, apart):
    """The examples S05_1, S06 and S07 of metrodata.de."""
    budget = next(e for e in EXAMPLES if subject in e.subject).budget()
    assert budget.value[0] == pytest.approx(y, rel=1e-12)
    assert budget.u[0] == pytest.approx(u, rel=apart)


def test_the_product_of_s4_is_of_second_order():
    budget = NAMED["EA-4/02, S4"].budget()
    product = math.sqrt(budget.share_higher[0]) * budget.u[0]
    assert product == pytest.approx(11.8, abs=0.05)


def test_s2_as_a_line():
    line = result_line(NAMED["EA-4/02, S2"].budget())
    assert "u = 0.029" in line and "10000.025" in line


def test_s9_has_the_factor_of_a_rectangle():
    assert 0.95 * math.sqrt(3.0) == pytest.approx(NAMED["EA-4/02, S9"].k, abs=5e-3)


def test_e2_is_the_interval_of_scipy():
    budget = NAMED["NIST TN 1900, E2"].budget()
    assert budget.nu_eff[0] == pytest.approx(21.0)
    expected = stats.t.interval(0.95, 21, budget.value[0], budget.u[0])
    assert budget.interval("y") == pytest.approx(expected, rel=1e-9)


def test_normal_with_degrees_of_freedom_differs_from_its_t():
    """The GUM counts dof of a normal input, Monte Carlo draws it as normal: take the t instead."""

    def x(v):
        return v["x"]

    normal = propagate(x, Inputs({"x": Normal(0.0, 1.0, dof=4)}))
    assert normal.k[0] == pytest.approx(stats.t.ppf(0.975, 4))
    drawn = propagate_distributions(x, Inputs({"x": Normal(0.0, 1.0, dof=4)}), draws=20_000)
    low, high = drawn.interval("y")
    assert high - low == pytest.approx(2 * 1.96, rel=0.03)
