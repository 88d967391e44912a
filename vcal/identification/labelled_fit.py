"""The parameters of a fit as labelled tables."""

from typing import TYPE_CHECKING, Any

import numpy as np

from ..labelled import labelling
from ..units import si_unit

if TYPE_CHECKING:
    from .fit import Fit


def fit_frame(fit: "Fit") -> Any:
    """A `pandas.DataFrame` with a row per parameter (`Fit.parameter_values`).

    The index is (effect, parameter); the columns are value and standard_uncertainty in `unit`, and
    information, the share that comes from the data (nan for a shape parameter that does not move).
    """
    pandas = labelling("pandas")
    values = fit.parameter_values()
    information = dict(zip(_labels(fit), fit.information, strict=True))
    index = pandas.MultiIndex.from_tuples(
        [(key, p.name) for key, p, *_ in values], names=["effect", "parameter"]
    )
    return pandas.DataFrame(
        {
            "value": [float(value) for *_, value, _ in values],
            "standard_uncertainty": [float(u) for *_, u in values],
            "unit": [p.unit for _, p, *_ in values],
            "information": [information.get(f"{key}.{p.name}", np.nan) for key, p, *_ in values],
        },
        index=index,
    )


def fit_dataset(fit: "Fit") -> Any:
    """An `xarray.Dataset` of the parameters that were estimated, in SI units.

    Dimension ``parameter`` with labels ``"effect.parameter"``, and ``parameter_`` with the same
    labels; ``value``, ``standard_uncertainty``, ``information``, and ``covariance`` over both. The
    coordinate ``unit`` is the SI unit of each parameter.
    """
    xarray = labelling("xarray")
    labels = _labels(fit)
    listed = {f"{key}.{p.name}": (p, value, u) for key, p, value, u in fit.parameter_values()}
    parameters = [listed[label] for label in labels]
    si = np.array([p.si for p, *_ in parameters])
    value, u = si * [v for _, v, _ in parameters], si * [u for *_, u in parameters]
    # The covariance has solver units, whose ratio to SI is that of the standard uncertainties.
    sigma = np.sqrt(np.diag(fit.covariance))
    scale = np.divide(u, sigma, out=np.zeros_like(u), where=sigma > 0.0)
    found = xarray.Dataset(
        {
            "value": ("parameter", value),
            "standard_uncertainty": ("parameter", u),
            "information": ("parameter", np.asarray(fit.information)),
            "covariance": (
                ("parameter", "parameter_"),
                fit.covariance * np.outer(scale, scale),
            ),
        },
        coords={
            "parameter": labels,
            "parameter_": labels,
            "unit": ("parameter", [si_unit(p.unit) for p, *_ in parameters]),
        },
        attrs={
            "machine": fit.model.chain.text,
            "chi2": fit.chi2,
            "degrees_of_freedom": fit.dof,
            "units": "SI, by parameter in the coordinate unit",
        },
    )
    return found


def _labels(fit: "Fit") -> list[str]:
    return [f"{key}.{p.name}" for key, p in fit.entries]
