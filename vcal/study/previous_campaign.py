"""``[model] from``: the posterior of the geometric errors in the report of an earlier campaign."""

import json
from typing import Annotated

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from ..effects.geometric import GeometricErrors
from ..effects.previous import PreviousGeometry
from ..machine.chain import Chain
from .folder import Folder
from .messages import listed, refusal

_Finite = Annotated[float, Field(allow_inf_nan=False)]


class _Parameter(BaseModel):
    name: str
    unit: str
    value: _Finite


class _Posterior(BaseModel):
    """The key ``posterior`` of a report."""

    machine: str
    parameters: list[_Parameter]
    covariance: list[list[_Finite]]


class _Report(BaseModel):
    model_config = ConfigDict(extra="ignore")
    posterior: _Posterior


def with_posterior(
    errors: GeometricErrors, name: str, chain: Chain, folder: Folder, file: str
) -> PreviousGeometry:
    """The declared geometric errors with the posterior in the report `name` as prior.

    Raises `StudyError` for a file that is no report of such a campaign, for another machine, and
    where the declared errors have other parameters.
    """
    text = folder.path(name, "the report.json of a campaign").read_text(encoding="utf-8")
    expected = "the report.json of an arm, written by vcal loop"
    try:
        found = _Report.model_validate(json.loads(text)).posterior
    except (ValueError, RecursionError) as error:
        missing = isinstance(error, ValidationError) and error.errors()[0]["loc"] == ("posterior",)
        what = "no posterior of geometric errors" if missing else "what is no such report"
        raise refusal(name, "file", what, expected, "name another file") from error
    if found.machine != chain.text:
        raise refusal(
            file,
            "key model.from",
            f"the report of {found.machine!r}",
            f"one of the same machine, {chain.text!r}",
            "correct the machine, or name another report",
        )
    own = {p.name: p.unit for p in errors.parameters}
    theirs = {p.name: p.unit for p in found.parameters}
    if own != theirs:
        differ = sorted(set(own.items()) ^ set(theirs.items()))
        raise refusal(
            file,
            "key model.from",
            f"a report with other geometric errors ({listed(dict(differ), 5)})",
            "the [model.geometric] of that campaign",
            "declare the same family, links and travels",
        )
    k = len(own)
    if [len(row) for row in found.covariance] != list(range(1, k + 1)):
        raise refusal(
            name, "key posterior.covariance", "rows that are no triangle", expected, "run it again"
        )
    lower = np.zeros((k, k))
    for i, row in enumerate(found.covariance):
        lower[i, : i + 1] = row
    place = {p.name: i for i, p in enumerate(found.parameters)}
    order = [place[p.name] for p in errors.parameters]
    covariance = (lower + np.tril(lower, -1).T)[np.ix_(order, order)]
    mean = np.array([p.value for p in found.parameters])[order]
    if not (np.diag(covariance) > 0.0).all() or np.linalg.eigvalsh(_unit(covariance))[0] < -1e-6:
        raise refusal(
            name,
            "key posterior.covariance",
            "a matrix that is no covariance",
            "variances above zero, and no negative eigenvalue",
            "run that campaign again",
        )
    return PreviousGeometry.of(errors, mean, covariance)


def _unit(covariance: np.ndarray) -> np.ndarray:
    sigma = np.sqrt(np.diag(covariance))
    return covariance / np.outer(sigma, sigma)
