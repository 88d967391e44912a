"""Results that are kept by the objects they were made of."""

import numpy as np

from vcal.numerics.identity_cache import IdentityCache


def test_the_very_same_objects_give_the_same_result():
    kept, made = IdentityCache[int](2), []

    def of(*objects):
        return kept.of(objects, lambda: made.append(objects) or len(made))

    one, equal = np.zeros(3), np.zeros(3)
    assert of(one, "J1") == of(one, "".join(["J", "1"])) == 1
    # Equal is not the same, as it may be changed later.
    assert of(equal, "J1") == 2
    assert of(one, "J1") == 1
    # The one that was not asked for longest goes.
    assert of(one, "J2") == 3
    assert of(one, "J1") == 1
    assert of(equal, "J1") == 4


def test_no_other_object_gets_the_place_of_one_that_is_gone():
    kept = IdentityCache[float](10_000)
    # Numbers of objects that are gone are given again.
    found = [kept.of((np.array([float(i)]),), lambda i=i: float(i)) for i in range(1000)]
    assert found == [float(i) for i in range(1000)]
