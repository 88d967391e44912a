"""Which error motions and squareness errors the readings of a plan determine without a prior."""

from dataclasses import dataclass

import numpy as np

from ..effects.geometric import ErrorMotion, GeometricErrors, LocationError
from ..identification.rank import FREE, nominal_jacobian
from ..instruments.base import Instrument
from ..machine.chain import Chain
from ..machine.error_functions import Legendre
from ..machine.plan import Plan
from ..model.forward import Model
from .geometric_family import squareness_errors

_SIZE = 1e-5
_DEGREES = 3
"""Highest Legendre degree of every error motion."""
_FREE = 1e-7
"""Share of a column, or singular value for columns of unit length, that counts as zero after the
nuisances are projected out."""
_PART = 1e-3
"""Component in an undetermined combination from which a coefficient counts as part of it."""


@dataclass(frozen=True)
class Determined:
    """Result of `determined_errors`."""

    columns: int
    """Number of coefficients of all errors."""
    rank: int
    """Number of independent combinations that the readings determine."""
    errors: int
    """Number of errors: 21 for three axes."""
    unseen: tuple[str, ...]
    """Errors on which no reading depends, other than as a nuisance of the instrument does."""
    mixed: tuple[str, ...]
    """Errors of which some coefficients cannot be separated from others, or from nuisances."""


def determined_errors(chain: Chain, instrument: Instrument, plan: Plan) -> Determined:
    """Rank of the derivative of the readings by the error motions of all linear axes (Legendre
    degrees 1 to 3; straightness 2 and 3, as its slope is a squareness) and by the squareness
    errors, beside the nuisances of the instrument.

    The nuisances are projected out; other effects of the instrument, known with an uncertainty,
    count as known. An error is determined if a change of its coefficients cannot be undone by other
    errors and nuisances.
    """
    motions = []
    for joint in chain.joints:
        if joint.turns:
            continue
        x = np.asarray(plan.x(joint.name))
        ends = float(x.min()), max(float(x.max()), float(x.min()) + 1e-9)
        own = "XYZ"[int(np.argmax(np.abs(np.asarray(joint.direction))))]
        for c in "XYZABC":
            lowest = 2 if c in "XYZ" and c != own else 1
            basis = Legendre(ends, tuple(range(lowest, _DEGREES + 1)), _SIZE)
            motions.append(ErrorMotion(f"E{c}{joint.name}", joint.name, basis))
    locations = tuple(LocationError.of(chain, name, _SIZE) for name in squareness_errors(chain))
    errors = GeometricErrors(motions=tuple(motions), locations=locations)
    nuisances = [e for e in instrument.effects(plan) if e.kind == "nuisance"]
    model = Model(chain, instrument, (errors, *nuisances))
    J = nominal_jacobian(model, plan)
    J = J / np.asarray(instrument.noise(plan, np.zeros(J.shape[:2])))[:, :, None]
    J = J.reshape(-1, J.shape[-1])
    owners = [entry.parameter.name.split(".")[0] for entry in model.entries]
    k = len(errors.parameters)
    own, others = J[:, :k], J[:, k:]
    left = own
    if others.shape[1]:
        u, sizes, _ = np.linalg.svd(others / np.linalg.norm(others, axis=0), full_matrices=False)
        u = u[:, sizes > FREE]
        left = own - u @ (u.T @ own)
    norms = np.linalg.norm(own, axis=0)
    seen = np.linalg.norm(left, axis=0) > _FREE * np.maximum(norms, 1e-300)
    scaled = left / np.where(norms > 0.0, norms, 1.0)
    _, sizes, vt = np.linalg.svd(scaled, full_matrices=True)
    rank = int((sizes > _FREE).sum())
    free = np.abs(vt[rank:]).max(0, initial=0.0) > _PART
    names = list(dict.fromkeys(owners[:k]))
    mine = {name: np.array([owner == name for owner in owners[:k]]) for name in names}
    unseen = tuple(name for name in names if not (seen & mine[name]).any())
    mixed = tuple(n for n in names if n not in unseen and (free & mine[n]).any())
    return Determined(k, rank, len(names), unseen, mixed)
