"""An identified machine with a known posterior, and the oracle's case behind it."""

import numpy as np

import vcal
from oracle import make_case, with_errors, write_study
from oracle.kinematics import TABLE_COLUMNS, compose, error_motions


def identified(folder, seed=2):
    """A case of the oracle, and a machine whose error motions are known to a third of their size,
    with the root of the covariance.
    """
    case = make_case("laser_tracker", seed=seed, plan={"shape": (3, 3, 2)})
    study = vcal.load_study(write_study(folder, case))
    (effect,) = (e for e in study.model.effects if e.key == "geometric")
    k = len(effect.amplitudes)
    random = np.random.default_rng(11)
    root = 0.3 * np.tril(random.normal(size=(k, k))) / np.sqrt(k)
    machine = vcal.IdentifiedMachine(
        chain=study.chain,
        effects=(effect,),
        theta=random.normal(size=k),
        shapes=({},),
        shape_steps=(),
        covariance=root @ root.T,
        planned=root @ root.T,
        prior=np.ones(k),
        volume=np.asarray(case.machine.travel),
    )
    return case, machine, root


def exact_points(case, effect, theta, q):
    """Tool points by the oracle's exact kinematics, for error motions in solver units."""
    rows = {}
    for p, value in zip(effect.amplitudes, theta, strict=True):
        motion, _, label = p.name.partition(".")
        if motion not in rows:
            wide = np.array(case.machine.table[motion], float)
            rows[motion] = np.where(np.isin(TABLE_COLUMNS, ["n1", "n2"]), wide, 0.0)
        rows[motion][TABLE_COLUMNS.index(label or "a0")] = value * p.step
    drawn = with_errors(case.machine, rows)
    return compose(drawn, q, *error_motions(drawn, q))
