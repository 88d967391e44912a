"""What the beams of the laser frame see, and the bias of taking eight errors for zero."""

import numpy as np
import pytest

from vcal import Model, predict
from vcal.machine.error_functions import Legendre
from vcal.reproduce.laser_frame.seen import seen
from vcal.reproduce.laser_frame.setting import (
    DEGREES,
    OTHERS,
    SQUARENESSES,
    THIRTEEN,
    TRAVEL,
    errors,
    frame_setup,
)


@pytest.mark.parametrize(
    ("path", "lever", "rank", "mixed", "invisible"),
    [
        ("3d", 0.0, 37, (), ("ECY", "EAZ", "EBZ", "ECZ")),
        ("planar", 0.0, 33, ("EBY", "EB0Z"), ("ECY", "EAZ", "EBZ", "ECZ")),
        ("3d", 0.0262, 37, (), ()),
    ],
)
@pytest.mark.thorough
def test_rank_and_what_is_behind_it(path, lever, rank, mixed, invisible):
    found = seen(path, lever)
    assert (found.columns, found.rank) == (37, rank)
    assert set(found.mixed) == set(mixed)
    assert set(found.invisible) == set(invisible)


def test_the_bias_by_finite_differences():
    """Least squares by numpy, on readings that the forward model gives for one error at a time."""
    chain, instrument, plan = frame_setup()

    def columns(*effects):
        model = Model(chain, instrument, effects)
        steps = 1e-2 * np.eye(len(model.entries))
        moved = [np.asarray(predict(model, plan, h) - predict(model, plan, -h)) for h in steps]
        return np.stack([m.ravel() / 2e-2 for m in moved], 1)

    one = dict.fromkeys(DEGREES, 1e-5) | dict.fromkeys(SQUARENESSES, 1e-5)
    own = errors(chain, THIRTEEN, one)
    j13, j8 = columns(own, *instrument.effects(plan)), columns(errors(chain, OTHERS, one))
    put = np.linalg.lstsq(j13, j8, rcond=1e-9)[0]
    names = [p.name.split(".")[0] for p in own.amplitudes]
    found = seen(translation_um=10.0, rotation_urad=10.0).bias
    for name in ("EZX", "EXX", "EAX", "EC0Y"):
        rows = put[[i for i, n in enumerate(names) if n == name]] * 10.0
        if name in SQUARENESSES:
            largest = np.linalg.norm(rows)
        else:
            x = np.linspace(*TRAVEL[name[2]], 21)
            family = np.asarray(Legendre(TRAVEL[name[2]], DEGREES[name], 1.0).functions(x))
            largest = np.linalg.norm(family @ rows, axis=1).max()
        assert found[name] == pytest.approx(largest, rel=1e-3)
    # Twice the others, twice the bias.
    assert seen(translation_um=20.0, rotation_urad=20.0).bias["EAX"] == pytest.approx(
        2.0 * found["EAX"], rel=1e-6
    )
