"""Error against measuring time: choice, bound, gradient and front."""

import numpy as np
import pytest

from vcal.design import volumetric_gram
from vcal.model.forward import Model
from vcal.reproduce.artefact_design.expected import bayes_um, task
from vcal.reproduce.artefact_design.searches import (
    AVERAGE,
    FAMILIES,
    Robust,
    check_inside,
    robust,
    with_spare,
)
from vcal.reproduce.artefact_design.setting import (
    KNOWN,
    NOMINAL,
    POSES,
    Family,
    ball_line,
    grid_points,
    machine,
    outer_faces,
    placed,
)
from vcal.reproduce.artefact_design.timing import (
    NOMINAL_S,
    Chosen,
    Design,
    Trade,
    candidates,
    joined,
    seconds,
    trade,
)


@pytest.fixture(scope="module")
def given():
    return task()


def test_time():
    assert seconds(11, 12) == NOMINAL_S == 6240.0
    assert seconds(5, 4) == 4 * (300.0 + 100.0)


def test_candidates_are_feasible():
    offered = candidates(7, scatter=30)
    assert offered.rotation.shape == (66, 3, 3)
    check_inside(offered)
    R = np.asarray(offered.rotation)
    np.testing.assert_allclose(R @ R.swapaxes(1, 2), np.broadcast_to(np.eye(3), R.shape), atol=1e-9)
    first = placed(outer_faces(), ball_line(7, *NOMINAL[1:]))
    np.testing.assert_allclose(offered.origin[:12], first.origin)
    again = candidates(7, scatter=30, seed=1)
    assert np.abs(np.asarray(again.origin - offered.origin)[36:]).min(0).max() > 0.0
    assert candidates(7, scatter=0).rotation.shape[0] == 12 * len(POSES)
    check_inside(with_spare(offered, 3))
    with pytest.raises(ValueError, match="2 poses more than places"):
        with_spare(offered, -2)


def test_front():
    def made(balls, count, rms):
        poses = placed(outer_faces()[:1], ball_line(balls, 0.0, 0.0))
        return Design(balls, count, "", Chosen(poses, rms, rms), rms, poses)

    some = Trade("S", 1.5, (made(5, 4, 3.0), made(5, 5, 3.1), made(7, 5, 1.4)))
    assert [(d.balls, d.count) for d in some.front] == [(5, 4), (7, 5)]
    assert some.cheapest().balls == 7 and some.share == pytest.approx(5 * 440 / 6240)
    assert some.cheapest(3.05).count == 4
    assert some.cheapest(1.0) is None and Trade("S", 1.0, some.designs).share is None
    more = joined(some, Trade("S", 1.5, (made(5, 4, 2.0), made(9, 4, 1.3))))
    assert [d.rms_um for d in more.front] == [2.0, 1.3]


@pytest.mark.campaign
def test_a_small_trade(given):
    """What is said of a design is what the theory says of its poses; every step gains."""
    done = trade(given, knowns=("S",), shapes={5: (4, 3)}, scatter=14, starts=1)["S"]
    assert [d.count for d in done.designs] == [3, 4]
    assert done.nominal_um == pytest.approx(1.423, abs=1e-3)
    for design in done.designs:
        chosen = design.chosen
        assert chosen.bound_um <= chosen.rms_um
        assert design.rms_um < 0.8 * chosen.rms_um
        assert design.poses.rotation.shape[0] == design.count
        check_inside(design.poses)
        balls = np.asarray(design.poses.balls)
        assert balls.shape == (5, 3) and np.abs(balls[:, 1:]).max() <= 0.06 + 1e-12
        assert np.ptp(balls[:, 0]) == pytest.approx(1.5)
    last = done.designs[-1]
    assert bayes_um(given, last.poses, "S")[0] == pytest.approx(last.rms_um, rel=1e-9)
    assert bayes_um(given, last.chosen.poses, "S")[0] == pytest.approx(last.chosen.rms_um, rel=1e-9)


@pytest.mark.campaign
def test_as_good_as_nominal_in_little_more_than_half_the_time(given):
    found = trade(given, shapes={9: (7,), 11: (6,)})
    for known in KNOWN:
        assert found[known].share <= 0.55
        best = found[known].cheapest()
        assert bayes_um(given, best.poses, known)[0] == pytest.approx(best.rms_um, rel=1e-9)


# --- several families ---


@pytest.mark.thorough
def test_families_by_hand(given):
    """Amplitudes scale the Gram matrix of their unknowns; other waves are other functions."""

    def made(family):
        chain, errors = machine(family)
        model = Model(chain, given.model.instrument, (errors,))
        return model, np.diag(volumetric_gram(model, grid_points(chain, (30, 3, 3))).raw)

    names = [e.parameter.name for e in given.model.entries]
    plain = made(Family())[1]
    size = np.array([2.0 if n[1] in "ABC" else 0.5 for n in names])
    twice = made(FAMILIES["rotations x 2, translations / 2"])[1]
    np.testing.assert_allclose(twice, plain * size**2, rtol=1e-9)
    other, waves = made(FAMILIES["other waves"])
    assert len(other.entries) == 90
    # Lines stay what they are, and the waves of X do not.
    line, wave = names.index("EXX.a1"), names.index("EXX.b1")
    assert waves[line] == pytest.approx(plain[line]) and abs(waves[wave] / plain[wave] - 1.0) > 0.1


@pytest.mark.thorough
def test_average_over_the_families():
    found = Robust("S", ("a", "b"), {}, {"nominal": (2.0, 4.0), "a": (1.0, 3.0)})
    assert found.average_um("nominal") == pytest.approx(10.0**0.5)


@pytest.mark.campaign
def test_robust_design(given):
    """The average is never worse than that of the design for the first family."""
    nominal = placed(outer_faces()[::2], ball_line(*NOMINAL))
    found = robust("B", nominal=nominal, starts=1, steps=60)
    first, *others = found.families
    assert list(found.rms_um) == ["nominal", first, *others, AVERAGE]
    assert found.average_um(AVERAGE) <= found.average_um(first)
    assert found.average_um(AVERAGE) < found.average_um("nominal")
    for i, family in enumerate(found.families):
        own = task(FAMILIES[family])
        for design, poses in found.designs.items():
            check_inside(poses)
            judged = bayes_um(own, poses, "B")[0]
            assert judged == pytest.approx(found.rms_um[design][i], rel=1e-9)
