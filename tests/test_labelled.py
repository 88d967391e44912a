"""Results as labelled tables, and as short texts."""

import sys

import numpy as np
import pytest

from oracle import make_case, write_study
from vcal import close_loop, load_study
from vcal.geometry.error_motions import error_motion_tables
from vcal.units import si_unit


@pytest.fixture(scope="module")
def study(tmp_path_factory):
    effect = {"effect": "backlash", "axis": "Y", "size_um": 25.0}
    case = make_case("laser_tracker", seed=7, effects=[effect])
    return load_study(write_study(tmp_path_factory.mktemp("labelled") / "study", case))


@pytest.fixture(scope="module")
def closure(study):
    return close_loop(
        study.model, study.measurement, check=study.check, effects=["backlash"], draws=100
    )


def test_a_fit_as_a_data_frame(closure):
    frame = closure.after.to_pandas()
    row = frame.loc[("backlash Y", "size")]
    assert abs(abs(row.value) - 25.0) < 4.0 * row.standard_uncertainty < 6.0
    assert row.unit == "um"
    assert 0.9 < row.information <= 1.0
    values = closure.after.parameter_values()
    assert [*frame.index] == [(key, p.name) for key, p, *_ in values]
    assert np.allclose(frame.value, [value for *_, value, _ in values])


def test_a_fit_as_a_dataset_in_si(closure):
    fit = closure.after
    found = fit.to_xarray()
    one = found.sel(parameter="backlash Y.size")
    frame = fit.to_pandas()
    row = frame.loc[("backlash Y", "size")]
    assert float(one.value) == pytest.approx(1e-6 * row.value)
    assert str(one.unit.values) == "m"
    variance = found.covariance.sel(parameter="backlash Y.size", parameter_="backlash Y.size")
    assert float(variance) == pytest.approx((1e-6 * row.standard_uncertainty) ** 2)
    # A covariance of different units: the correlations are those of the solver's.
    sigma = np.sqrt(np.diag(fit.covariance))
    u = found.standard_uncertainty.values
    expected = fit.covariance / np.outer(sigma, sigma)
    assert np.allclose(found.covariance.values / np.outer(u, u), expected, atol=1e-9)


def test_a_closure_as_tables(closure):
    effects = closure.to_pandas()
    assert [*effects.index] == [("backlash Y", "size")]
    assert effects.status.tolist() == ["named"]
    found = closure.to_xarray()
    for table in error_motion_tables(closure.after):
        curve = found[table.name]
        assert curve.attrs["units"] in ("m", "rad")
        assert np.allclose(1e6 * curve.values, table.value if curve.dims else table.value[0])
    assert found["EXX"].dims == ("position_X",)
    assert found["position_X"].attrs["units"] == "m"


def test_texts_fit_on_a_screen(study, closure):
    for one in (study, closure, closure.after):
        said = repr(one)
        assert len(said.splitlines()) <= 20
        assert len(said) < 1200
    assert "backlash Y" in repr(closure)
    assert "<table>" in closure._repr_html_()
    assert closure.after._repr_html_().count("<tr>") == len(closure.after.to_pandas()) + 1
    assert study.name in repr(study)


def test_a_library_that_is_missing_is_named(closure, monkeypatch):
    monkeypatch.setitem(sys.modules, "pandas", None)
    with pytest.raises(ImportError, match=r"pandas is not installed.*pip install 'vcal\[data\]'"):
        closure.to_pandas()


@pytest.mark.parametrize(
    ("unit", "si"), [("um/(m K)", "m/(m K)"), ("deg", "rad"), ("1", "1"), ("urad/m2", "rad/m2"),
                     ("um/h", "m/s"), ("", "1"), ("um/K", "m/K")]
)  # fmt: skip
def test_si_units(unit, si):
    assert si_unit(unit) == si
