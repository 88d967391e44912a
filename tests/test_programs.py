"""Programs that no other one contains: what they compute, and options that go away."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from vcal.numerics import compiled as programs
from vcal.numerics.arrays import namespace
from vcal.numerics.compiled import filter_jit_outermost, jit_outermost


@pytest.fixture
def fresh_options():
    """The compiler is asked anew, before and after."""
    programs._options.cache_clear()
    yield
    programs._options.cache_clear()


def powers(x, twice: bool):
    return jnp.sin(x) ** (2 if twice else 1), "of a sine"


def test_they_compute_what_is_written():
    x = np.linspace(-3.0, 3.0, 101)
    for twice in (False, True):
        found, what = filter_jit_outermost(powers)(x, twice)
        np.testing.assert_allclose(found, np.sin(x) ** (1 + twice), rtol=1e-14, atol=1e-300)
        assert what == "of a sine"
    assert filter_jit_outermost(powers).__name__ == "powers"
    found = jit_outermost(lambda x: powers(x, True)[0])(x)
    np.testing.assert_allclose(found, np.sin(x) ** 2, rtol=1e-14, atol=1e-300)


def test_they_are_no_part_of_another_program():
    with pytest.raises(ValueError, match="top-level"):
        jax.jit(lambda x: filter_jit_outermost(powers)(x, True)[0])(jnp.ones(3))
    with pytest.raises(ValueError, match="top-level"):
        jax.jit(jit_outermost(lambda x: 2.0 * x))(jnp.ones(3))


def test_an_option_that_the_compiler_no_longer_knows_is_left_out(monkeypatch, fresh_options):
    monkeypatch.delenv("XLA_FLAGS", raising=False)
    monkeypatch.setattr(programs, "_OPTIONS", programs._OPTIONS | {"xla_no_such_option": 1})
    known = programs._options()
    assert "xla_no_such_option" not in known
    # Every release that vcal runs with has this one.
    assert known["xla_backend_optimization_level"] == 1
    assert float(filter_jit_outermost(powers)(np.zeros(1), False)[0][0]) == 0.0


def test_an_option_that_the_user_has_set_keeps_its_value(monkeypatch, fresh_options):
    monkeypatch.delenv("XLA_FLAGS", raising=False)
    own = programs._options()
    programs._options.cache_clear()
    monkeypatch.setenv("XLA_FLAGS", "--xla_other=1 --xla_backend_optimization_level=0")
    assert programs._options() == own | {"xla_backend_optimization_level": "0"}
    assert float(filter_jit_outermost(powers)(np.zeros(1), False)[0][0]) == 0.0


def test_numpy_outside_of_programs_and_jax_inside():
    assert namespace(np.ones(3), 1.0) is np
    assert namespace(np.ones(3), jnp.ones(3)) is jnp
    seen = []
    jax.jit(lambda x: seen.append(namespace(1.0, x)) or x)(np.ones(3))
    assert seen == [jnp]
