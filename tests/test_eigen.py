"""Eigenvalues of symmetric matrices, also where divide and conquer fails."""

import numpy as np
import pytest

from vcal.numerics import eigen
from vcal.numerics.eigen import eigh


@pytest.fixture
def failing(monkeypatch):
    """Divide and conquer that fails for matrices with a given corner, as it does for few."""
    whole = np.linalg.eigh

    def sometimes(matrices):
        if np.any(np.asarray(matrices)[..., 0, 0] == 3.0):
            raise np.linalg.LinAlgError("Eigenvalues did not converge")
        return whole(matrices)

    monkeypatch.setattr(eigen.np.linalg, "eigh", sometimes)


@pytest.mark.parametrize("shape", [(), (4,), (2, 3)])
def test_a_matrix_that_does_not_converge(failing, shape):
    root = np.random.default_rng(1).normal(size=(*shape, 5, 5))
    matrices = root @ root.swapaxes(-1, -2)
    matrices[..., 0, 0][(0,) * len(shape)] = 3.0
    values, vectors = eigh(matrices)
    assert values.shape == (*shape, 5) and vectors.shape == (*shape, 5, 5)
    np.testing.assert_allclose(values, np.linalg.eigvalsh(matrices), rtol=0, atol=1e-12)
    again = (vectors * values[..., None, :]) @ vectors.swapaxes(-1, -2)
    np.testing.assert_allclose(again, matrices, atol=1e-12)


def test_a_matrix_that_is_not_finite(failing):
    with pytest.raises(np.linalg.LinAlgError):
        eigh(np.array([[3.0, np.nan], [np.nan, 1.0]]))
