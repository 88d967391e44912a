"""The engine of Monte Carlo campaigns: the same numbers in every way there is to get them."""

import json
import math
import os
import pickle
import signal
import subprocess
import sys
import time
import tracemalloc
from concurrent.futures import Future

import numpy as np
import pytest

import vcal
from vcal.uncertainty import Field, Output, numerical_tolerance, stream
from vcal.uncertainty.adaptive import step_size
from vcal.uncertainty.checkpoint import STATE
from vcal.uncertainty.intervals import coverage_interval, interval_ranks, ranked_value
from vcal.uncertainty.quantile_counts import quantile_ranks, sketch_of
from vcal.uncertainty.summary import digest

OUTPUTS = [Output("a"), Output("b", (2,))]
FIELDS = [Field("map", (4, 3), (0.025, 0.5, 0.975))]


def evaluate(first, count):
    """Three correlated scalars far from zero, and a field, of which every draw is its own."""
    rng = np.random.default_rng([7, first])
    z = rng.standard_normal((count, 3))
    a = 1e6 + 2.0 * z[:, 0]
    b = np.stack([np.exp(z[:, 0]), z[:, 0] + z[:, 1] ** 2], axis=1)
    return {"a": a, "b": b, "map": 5.0 + rng.standard_normal((count, 4, 3)) * z[:, 2, None, None]}


def all_values(draws, block=100):
    """The same draws as plain arrays."""
    parts = [evaluate(first, block) for first in range(0, draws, block)]
    scalars = np.concatenate([np.column_stack([part["a"], part["b"]]) for part in parts])
    return scalars[:draws], np.concatenate([part["map"] for part in parts])[:draws]


def run(draws=1234, outputs=OUTPUTS, fields=FIELDS, function=evaluate, block=100, **options):
    return stream(function, draws, outputs, fields=fields, block=block, **options)


def assert_same(found, expected):
    """Bit for bit."""
    for name in ("mean", "covariance", "minimum", "maximum", "values"):
        np.testing.assert_array_equal(getattr(found, name), getattr(expected, name), name)
    for own, other in zip(found.scatter, expected.scatter, strict=True):
        np.testing.assert_array_equal(own, other)
    assert (found.draws, found.failed, found.kept) == (
        expected.draws,
        expected.failed,
        expected.kept,
    )
    for own, other in zip(found.columns, expected.columns, strict=True):
        np.testing.assert_array_equal(own.total, other.total)
        np.testing.assert_array_equal(own.edges, other.edges)
    for name, own in found.fields.items():
        other = expected.fields[name]
        np.testing.assert_array_equal(own.mean, other.mean)
        np.testing.assert_array_equal(own.u, other.u)
        for q, value in own.quantiles.items():
            np.testing.assert_array_equal(value, other.quantiles[q])


# ---------------------------------------------------------------- what is known of the draws


def test_moments_quantiles_and_range_are_those_of_all_draws():
    found, (values, field) = run(), all_values(1234)
    assert found.labels == ("a", "b[0]", "b[1]")
    assert (found.draws, found.kept, found.failed) == (1234, "exact", {})
    np.testing.assert_array_equal(found.values, values)
    np.testing.assert_allclose(found.mean, values.mean(0), rtol=1e-13)
    np.testing.assert_allclose(found.covariance, np.cov(values.T), rtol=1e-10)
    np.testing.assert_allclose(found.u, values.std(0, ddof=1), rtol=1e-10)
    np.testing.assert_allclose(found.correlation, np.corrcoef(values.T), rtol=1e-10)
    np.testing.assert_array_equal(found.minimum, values.min(0))
    for q in (0.01, 0.3, 0.999):
        exact = np.quantile(values[:, 1], q, method="hazen")
        assert found.quantile("b[0]", q) == pytest.approx(exact, rel=1e-13)
    whole = found.fields["map"]
    np.testing.assert_allclose(whole.mean, field.mean(0), rtol=1e-13)
    np.testing.assert_allclose(whole.u, field.std(0, ddof=1), rtol=1e-12)
    np.testing.assert_array_equal(whole.maximum, field.max(0))


def test_a_spread_far_below_the_value_keeps_its_digits():
    def far(first, count):
        return {"y": 1e9 + 1e-3 * np.random.default_rng([1, first]).standard_normal(count)}

    found = stream(far, 50_000, [Output("y")], block=500)
    exact = np.std((found.values[:, 0] - 1e9), ddof=1)
    assert found.u[0] == pytest.approx(exact, rel=1e-9)


def test_field_quantiles_lie_within_their_bounds_of_the_exact_ones():
    found, (_, field) = run(20_000, block=1000), all_values(20_000, block=1000)
    whole = found.fields["map"]
    for q, values in whole.quantiles.items():
        error = np.abs(values - np.quantile(field, q, axis=0, method="hazen"))
        assert np.all(error <= whole.bounds[q] + 1e-12)
        assert np.all(whole.bounds[q] < 0.01)


def test_field_quantiles_of_few_draws_are_exact():
    found, (_, field) = run(200), all_values(200)
    for q, values in found.fields["map"].quantiles.items():
        np.testing.assert_allclose(values, np.quantile(field, q, axis=0, method="hazen"))
        assert not found.fields["map"].bounds[q].any()


def test_fields_alone_are_a_campaign_too():
    def only(first, count):
        return {"map": evaluate(first, count)["map"]}

    found = run(500, outputs=(), function=only)
    assert found.labels == () and found.mean.shape == (0,)
    np.testing.assert_allclose(found.fields["map"].mean, all_values(500)[1].mean(0))


def failing(first, count):
    values = {name: value.copy() for name, value in evaluate(first, count).items()}
    values["a"][3] = np.nan
    values["b"][3, 1] = -np.inf
    values["b"][10:14, 0] = np.inf
    values["map"][5, 1, 2] = np.nan
    return values


def test_draws_that_failed_are_counted_and_left_out():
    found, (values, field) = run(1000, function=failing), all_values(1000)
    assert found.failed == {"a": 10, "b[0]": 40, "b[1]": 10, "map": 10}
    index = np.arange(1000) % 100
    good = np.stack([index != 3, (index < 10) | (index > 13), index != 3], axis=1)
    for j in range(3):
        own = values[good[:, j], j]
        assert found.mean[j] == pytest.approx(own.mean(), rel=1e-13)
        assert found.u[j] == pytest.approx(own.std(ddof=1), rel=1e-10)
        for k in range(3):
            both = values[good[:, j] & good[:, k]]
            assert found.covariance[j, k] == pytest.approx(np.cov(both.T)[j, k], rel=1e-9)
    own = np.sort(values[good[:, 1], 1])
    assert found.interval("b[0]", 0.9) == coverage_interval(own, 0.9)
    whole = found.fields["map"]
    assert (whole.draws, whole.failed) == (990, 10)
    np.testing.assert_allclose(whole.mean, field[index != 5].mean(0), rtol=1e-13)
    sketched = run(1000, function=failing, keep=1500)
    assert sketched.kept == "sketch" and sketched.failed == found.failed
    assert sketched.columns[1].draws == 960


def test_an_output_that_always_fails_spoils_nothing_else():
    def never(first, count):
        return {"y": np.full(count, np.nan), "z": np.arange(first, first + count) + 0.5}

    for keep in (1_000_000, 500):
        found = stream(never, 1000, [Output("y"), Output("z")], block=100, keep=keep)
        assert found.failed == {"y": 1000}
        assert np.isnan(found.mean[0]) and np.isnan(found.u[0]) and found.mean[1] == 500.0
        ends = found.interval("z", 0.9)  # ranks 50 and 950 of 0.5, 1.5, ...
        assert ends == pytest.approx((49.5, 949.5), abs=found.interval_bound("z", 0.9))
        assert math.isnan(found.quantile("y", 0.5))
        with pytest.raises(ValueError, match="found 0 draws"):
            found.interval("y")


# ---------------------------------------------------------------- intervals and the sketch


@pytest.mark.parametrize(
    ("draws", "p", "low", "high"),
    [
        (100, 0.95, 3, 98),  # q = 95, (M - q)/2 = 2.5: integer part of 3
        (1000, 0.95, 25, 975),
        (21, 0.95, 1, 21),  # p M = 19.95: q = 20
        (10, 0.5, 3, 8),
    ],
)
def test_ranks_of_the_symmetric_interval(draws, p, low, high):
    assert interval_ranks(lambda ranks: ranks * 1.0, draws, p) == (low, high)


def test_the_shortest_interval_is_the_shortest_of_all():
    values = np.random.default_rng(0).exponential(size=4000)
    ordered = np.sort(values)
    q = 3800
    widths = {r: ordered[r + q - 1] - ordered[r - 1] for r in range(1, 4000 - q + 1)}
    r = min(widths, key=lambda r: widths[r])
    assert coverage_interval(values, 0.95, "shortest") == (ordered[r - 1], ordered[r + q - 1])
    low, high = coverage_interval(values, 0.95, "symmetric")
    assert (low, high) == (ordered[99], ordered[3899])


SHAPES = {
    "normal": lambda rng, n: 1e3 + rng.standard_normal(n),
    "cauchy": lambda rng, n: rng.standard_cauchy(n),
    "lognormal": lambda rng, n: np.exp(2.0 * rng.standard_normal(n)),
    "two peaks": lambda rng, n: np.where(rng.random(n) < 0.3, -100.0, 3.0) + rng.random(n),
    "steps": lambda rng, n: np.floor(rng.exponential(size=n)),
    "mostly zero": lambda rng, n: np.maximum(rng.standard_normal(n) - 2.5, 0.0),
    "shifts late": lambda rng, n: np.arange(n) ** 2.0,
    "constant": lambda rng, n: np.full(n, 3.25),
}


@pytest.mark.parametrize("shape", SHAPES)
def test_a_ranked_value_is_that_of_the_values_in_order(shape):
    """Also where the part of the values from which the bounds come says little of the others."""
    for n in (5, 120_001):
        values = SHAPES[shape](np.random.default_rng(5), n)
        ordered = np.sort(values)
        for rank in {1, 2, n // 40, n // 2, n - n // 40, n - 1, n} - {0}:
            assert ranked_value(values, rank) == ordered[rank - 1]
    periodic = np.tile(SHAPES[shape](np.random.default_rng(6), 24), 6_000)
    assert ranked_value(periodic, 3_600) == np.sort(periodic)[3_599]


@pytest.mark.parametrize("shape", SHAPES)
def test_a_sketch_agrees_with_the_values_to_its_bound(shape):
    values = SHAPES[shape](np.random.default_rng(3), 40_001)
    sketch = sketch_of(values[:10_000, None])
    for part in np.array_split(values, 7):
        sketch.add(part[:, None])
    column = sketch.column(values.min(), values.max(), 0)
    ordered = np.sort(values)
    for q in (0.0, 1e-4, 0.025, 0.31, 0.5, 0.975, 0.9999, 1.0):
        found, bound = column.quantile(q)
        ranks, weights = quantile_ranks(len(values), q)
        exact = weights @ ordered[ranks - 1]
        assert abs(found - exact) <= bound + 1e-9 * abs(exact)
        together = sketch.quantiles(values[None].min(1), values[None].max(1), len(values), q)
        np.testing.assert_allclose([t[0] for t in together], [found, bound], rtol=1e-12, atol=1e-12)
    low, high = coverage_interval(values, 0.95)
    (sketch_low, sketch_high), bound = column.interval(0.95, "symmetric")
    assert max(abs(sketch_low - low), abs(sketch_high - high)) <= bound + 1e-9 * abs(high)
    low, high = coverage_interval(values, 0.95, "shortest")
    (sketch_low, sketch_high), bound = column.interval(0.95, "shortest")
    assert sketch_high - sketch_low == pytest.approx(high - low, abs=2.0 * bound + 1e-9)
    inside = np.mean((values >= sketch_low - bound) & (values <= sketch_high + bound))
    assert inside >= 0.95


def test_the_bound_is_a_small_part_of_the_standard_error():
    values = np.random.default_rng(4).standard_normal((100_000, 1))
    sketch = sketch_of(values[:10_000])
    sketch.add(values)
    column = sketch.column(values.min(), values.max(), 0)
    error = math.sqrt(0.025 * 0.975 / 1e6) / 0.0584  # of the 2.5 % quantile, 1e6 draws
    assert 0.0 < column.quantile(0.025)[1] < 0.1 * error


def test_beyond_the_limit_quantiles_come_from_the_sketch_and_the_rest_stays():
    exact, sketched = run(3000), run(3000, keep=5000)
    assert (exact.kept, sketched.kept) == ("exact", "sketch")
    np.testing.assert_array_equal(sketched.mean, exact.mean)
    np.testing.assert_array_equal(sketched.covariance, exact.covariance)
    np.testing.assert_array_equal(sketched.values, exact.values[:1600])
    for output in exact.labels:
        for kind in ("symmetric", "shortest"):
            bound = sketched.interval_bound(output, 0.95, kind)
            assert 0.0 < bound < 0.005 * exact.u[exact.index(output)]
        np.testing.assert_allclose(
            sketched.interval(output), exact.interval(output), rtol=0, atol=bound
        )
        assert exact.interval_bound(output) == exact.quantile_bound(output, 0.1) == 0.0
        assert sketched.quantile(output, 0.1) == pytest.approx(
            exact.quantile(output, 0.1), abs=sketched.quantile_bound(output, 0.1)
        )


@pytest.mark.thorough
def test_many_outputs_have_coarser_bins_and_the_memory_does_not_grow():
    def many(first, count):
        return {"y": np.random.default_rng([2, first]).standard_normal((count, 2000))}

    found = stream(many, 600, [Output("y", (2000,))], block=100, keep=200_000)
    assert found.kept == "sketch" and len(found.columns[0].total) == 2**14 + 1

    def peak(draws):
        tracemalloc.start()
        try:
            run(draws, keep=30_000, block=500, function=evaluate)
            return tracemalloc.get_traced_memory()[1]
        finally:
            tracemalloc.stop()

    peak(20_000)
    assert peak(100_000) < 1.05 * peak(20_000)


# ---------------------------------------------------------------- the same in every way


@pytest.mark.parametrize("keep", [1_000_000, 1000])
def test_results_do_not_depend_on_the_chunk_or_the_folder(tmp_path, keep):
    expected = run(keep=keep)
    for chunk in (1, 3, 50):
        folder = tmp_path / str(chunk)
        assert_same(run(chunk=chunk, keep=keep), expected)
        assert_same(run(chunk=chunk, keep=keep, folder=folder, fingerprint="seed 7"), expected)
        assert_same(run(chunk=2, keep=keep, folder=folder, fingerprint="seed 7"), expected)


@pytest.mark.parametrize("keep", [1_000_000, 1000])
def test_a_campaign_goes_on_from_its_last_chunk_and_to_more_draws(tmp_path, keep):
    seen = []

    def breaking(first, count):
        if first == 800:
            raise OSError("the machine went down")
        return evaluate(first, count)

    def watching(first, count):
        seen.append(first)
        return evaluate(first, count)

    options = {"folder": tmp_path, "fingerprint": {"seed": 7}, "keep": keep}
    with pytest.raises(OSError, match="went down"):
        run(function=breaking, chunk=3, **options)
    assert_same(run(function=watching, **options), run(keep=keep))
    assert seen == list(range(600, 1300, 100))
    seen.clear()
    assert_same(run(2010, function=watching, chunk=2, **options), run(2010, keep=keep))
    assert seen[0] == 1200, "the block that was cut is computed again, whole"
    seen.clear()
    run(2010, function=watching, **options)
    assert seen == [2000]


def test_fewer_draws_than_the_folder_holds_are_refused(tmp_path):
    run(folder=tmp_path, fingerprint="seed 7")
    with pytest.raises(vcal.StudyError, match=r"found 1200 draws, expected at most the 500"):
        run(500, folder=tmp_path, fingerprint="seed 7")


def test_progress_is_told_chunk_by_chunk():
    told = []
    run(chunk=4, progress=lambda done, total: told.append((done, total)))
    assert told[-1] == (1234, 1234)
    assert len(told) == 4


SCRIPT = """
import sys, time
import numpy as np
from vcal.uncertainty import Field, Output, stream

def evaluate(first, count):
    rng = np.random.default_rng([7, first])
    time.sleep(0.002)
    return {"y": rng.standard_normal((count, 5)), "map": rng.random((count, 50))}

print("ready", flush=True)
stream(evaluate, 60_050, [Output("y", (5,))], fields=[Field("map", (50,), (0.5,))], block=100,
       chunk=4, folder=sys.argv[1], fingerprint="seed 7", keep=120_000)
"""


def killed_evaluate(first, count):
    rng = np.random.default_rng([7, first])
    return {"y": rng.standard_normal((count, 5)), "map": rng.random((count, 50))}


@pytest.mark.thorough
def test_killed_at_random_moments_it_ends_with_the_same_numbers(tmp_path):
    settings = {
        "outputs": [Output("y", (5,))],
        "fields": [Field("map", (50,), (0.5,))],
        "block": 100,
        "keep": 120_000,
    }
    moments, kills = np.random.default_rng(int(time.time())), 0
    for number in range(3):
        with subprocess.Popen(
            [sys.executable, "-c", SCRIPT, str(tmp_path)], stdout=subprocess.PIPE
        ) as process:
            assert process.stdout is not None and process.stdout.readline() == b"ready\n"
            while number == 0 and not (tmp_path / STATE).is_file() and process.poll() is None:
                time.sleep(0.001)  # one at least after the first chunk
            time.sleep(moments.uniform(0.0, 0.4))
            kills += process.poll() is None
            os.kill(process.pid, signal.SIGKILL)
    assert kills > 0
    line = (tmp_path / STATE).read_bytes().partition(b"\n")[0].partition(b" ")[2]
    assert json.loads(line)["fingerprint"]["campaign"] == "seed 7"
    options = {"folder": tmp_path, "fingerprint": "seed 7"}
    resumed = stream(killed_evaluate, 60_050, **settings, **options)
    assert_same(resumed, stream(killed_evaluate, 60_050, **settings))


DEVICES = """
import hashlib, sys
import jax
jax.config.update("jax_enable_x64", True)
import jax.numpy as jnp
import numpy as np
from vcal.uncertainty import Output, stream

seen = set()

@jax.jit
def block(key, first):
    keys = jax.vmap(lambda i: jax.random.fold_in(key, i))(first + jnp.arange(50, dtype=jnp.uint32))
    z = jax.vmap(lambda k: jax.random.normal(k, (3,)))(keys)
    return {"y": jnp.sin(z) @ jnp.ones((3, 2)) + z[:, :2] ** 3}

def evaluate(first, count, device=None):
    key = jax.device_put(jax.random.key(3), device)
    found = block(key, np.uint32(first))
    seen.update(found["y"].devices())
    return found

assert jax.local_device_count() == 2
for devices in ((), jax.local_devices(), jax.local_devices()[1:]):
    seen.clear()
    e = stream(evaluate, 1990, [Output("y", (2,))], block=50, devices=devices)
    assert len(seen) == max(len(devices), 1)
    numbers = [e.mean, e.covariance, e.values, *e.scatter, np.array(e.interval("y[0]"))]
    print(hashlib.sha256(b"".join(n.tobytes() for n in numbers)).hexdigest())
"""


@pytest.mark.slow
def test_results_do_not_depend_on_the_number_of_devices():
    flags = os.environ.get("XLA_FLAGS", "") + " --xla_force_host_platform_device_count=2"
    found = subprocess.run(
        [sys.executable, "-c", DEVICES],
        env=os.environ | {"XLA_FLAGS": flags, "JAX_PLATFORMS": "cpu"},
        capture_output=True,
        text=True,
        check=False,
    )
    assert found.returncode == 0, found.stderr
    lines = found.stdout.split()
    assert len(lines) == 3 and len(set(lines)) == 1


class Elsewhere:
    """Summarises blocks as another process would: what comes back has been bytes."""

    def __init__(self):
        self.travelled = []

    def __call__(self, first, count, device=None):
        return spoilt(first, count)

    def summaries(self, first, block, blocks, declared, layout):
        declared, layout = pickle.loads(pickle.dumps((declared, layout)))
        parts = (spoilt(first + i * block, block) for i in range(blocks))
        content = pickle.dumps(digest(parts, block, declared, layout))
        self.travelled.append((blocks, len(content)))
        coming = Future()
        coming.set_result(pickle.loads(content))
        return coming


def spoilt(first, count):
    """The same draws; some are not finite."""
    found = evaluate(first, count)
    if first == 4000:
        found["b"][5, 1], found["map"][7, 2, 1] = np.nan, np.inf
    return found


@pytest.mark.parametrize("keep", [10_000_000, 0, 45_000, 90_000])
def test_summaries_made_elsewhere_give_the_same_numbers(keep):
    """Bit for bit, where all, no, or the first 15,000 and 30,000 draws are kept."""
    elsewhere = Elsewhere()
    options = {"draws": 43_500, "block": 1000, "keep": keep}
    found = run(function=elsewhere, devices=range(3), **options)
    assert_same(found, run(function=spoilt, **options))
    several = [size for blocks, size in elsewhere.travelled if blocks == 10]
    assert len(several) == {10_000_000: 0, 0: 3, 45_000: 2, 90_000: 1}[keep]
    # The draws of 10 blocks are 1.2 MB.
    assert all(size < 200_000 for size in several[-2:])


def test_a_campaign_goes_on_with_summaries_made_elsewhere(tmp_path):
    options = {"block": 1000, "keep": 30_000, "fingerprint": "seed 7"}
    run(function=spoilt, draws=12_000, folder=tmp_path, **options)
    found = run(function=Elsewhere(), draws=31_000, folder=tmp_path, **options)
    assert_same(found, run(function=spoilt, draws=31_000, **options))


# ---------------------------------------------------------------- interruption


@pytest.mark.parametrize("where", ["evaluate", "progress"])
def test_an_interruption_ends_with_what_is_known(tmp_path, where):
    def interrupted(first, count):
        if where == "evaluate" and first == 700:
            raise KeyboardInterrupt
        return evaluate(first, count)

    def progress(done, total):
        if where == "progress" and done >= 600:
            raise KeyboardInterrupt

    options = {"folder": tmp_path, "fingerprint": "seed 7"}
    found = run(function=interrupted, chunk=2, progress=progress, **options)
    assert found.interrupted and 500 < found.draws < 1234
    whole = run(found.draws)
    assert not whole.interrupted
    assert_same(found, whole)
    assert_same(run(**options), run())


def test_an_interruption_before_anything_is_known_is_passed_on():
    def at_once(first, count):
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run(function=at_once)


# ---------------------------------------------------------------- files that were tampered with


@pytest.fixture
def folder(tmp_path):
    run(fingerprint={"seed": 7, "noise": 1.5}, folder=tmp_path, chunk=5)
    return tmp_path


def again(folder, **changes):
    options = {"fingerprint": {"seed": 7, "noise": 1.5}, "folder": folder} | changes
    return run(**options)


def parts(folder):
    return sorted(folder.glob("values-*.part"))


@pytest.mark.parametrize("share", [0.0, 0.001, 0.3, 0.9, 0.9999])
def test_a_file_that_was_cut_is_refused(folder, share):
    for path in (folder / STATE, parts(folder)[0]):
        whole = path.read_bytes()
        path.write_bytes(whole[: int(share * len(whole))])
        with pytest.raises(vcal.StudyError, match=rf"{path.name}: found .*delete the folder"):
            again(folder)
        path.write_bytes(whole + b"\0")
        with pytest.raises(vcal.StudyError, match=rf"{path.name}: found .*delete the folder"):
            again(folder)
        path.write_bytes(whole)
    again(folder)


def test_a_file_that_was_edited_is_refused(folder):
    rng = np.random.default_rng(0)
    for path in (folder / STATE, parts(folder)[1]):
        whole = path.read_bytes()
        for place in rng.integers(0, len(whole), 20):
            edited = bytearray(whole)
            edited[place] ^= 1
            path.write_bytes(edited)
            with pytest.raises(vcal.StudyError, match=path.name):
                again(folder)
        path.write_bytes(whole)
    again(folder)


def test_values_that_are_missing_or_exchanged_are_refused(folder, tmp_path_factory):
    first, second = parts(folder)[:2]
    whole = first.read_bytes()
    first.write_bytes(second.read_bytes())
    with pytest.raises(vcal.StudyError, match="other values than were written"):
        again(folder)
    first.unlink()
    with pytest.raises(vcal.StudyError, match="found no such file"):
        again(folder)
    first.write_bytes(whole)
    again(folder)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"fingerprint": {"seed": 8, "noise": 1.5}}, "found seed = 7, expected 8"),
        ({"fingerprint": {"seed": 7}}, r"found noise = 1.5, expected None"),
        ({"block": 50}, "found block = 100, expected 50"),
        ({"outputs": [Output("a"), Output("b", (3,))]}, "found outputs = "),
        ({"fields": [Field("map", (4, 3))]}, "found fields = "),
        ({"coverage": 0.99}, "found coverage = "),
        ({"keep": 100}, "found values kept at most = 10000000, expected 100"),
        ({"draws": "adaptive"}, "found number of draws = 'given', expected 'adaptive, 2 digits'"),
    ],
)
def test_a_folder_of_another_campaign_is_refused(folder, changes, message):
    with pytest.raises(vcal.StudyError, match=message):
        again(folder, **changes)


def test_leftovers_of_a_chunk_that_was_not_finished_are_removed(folder):
    odd = [
        folder / "values-000000099900-000000100000.part",
        folder / "values-000000001200-000000001300.part.new",
    ]
    for path in odd:
        path.write_bytes(b"half")
    (folder / "notes.txt").write_text("mine", encoding="utf-8")
    assert_same(again(folder), run())
    assert not any(path.exists() for path in odd)
    assert (folder / "notes.txt").is_file()


# ---------------------------------------------------------------- precision, adaptive campaigns


@pytest.mark.parametrize(
    ("u", "digits", "delta"),
    [
        (0.00035, 2, 0.5e-5),  # the three examples of JCGM 101, 7.9.2
        (0.00035, 1, 0.5e-4),
        (2.0, 1, 0.5),
        (0.0755, 2, 0.0005),
        (0.0996, 2, 0.005),  # rounds to 0.10
        (95.0, 1, 50.0),
        (0.0, 2, 0.0),
    ],
)
def test_numerical_tolerance(u, digits, delta):
    assert numerical_tolerance(u, digits) == pytest.approx(delta, rel=1e-12)


def test_size_of_a_sub_block():
    assert step_size(0.95) == step_size(0.99) == 10_000
    assert step_size(0.999) == 100_000
    assert step_size(0.95, block=768) == 14 * 768


def curve(first, count):
    rng = np.random.default_rng([11, first])
    x = rng.standard_normal((2, count))
    return {"y": 3.0 + 0.02 * x[0], "z": np.exp(0.5 * x[1])}


def clause_7_9_4(digits, p, most):
    """The adaptive procedure as the standard's list of steps has it, in plain numpy."""
    names, blocks, results = ("y", "z"), [], []
    while len(blocks) * 10_000 < most:
        first = len(blocks) * 10_000
        parts = [curve(first + k, 1000) for k in range(0, 10_000, 1000)]
        blocks.append({n: np.concatenate([part[n] for part in parts]) for n in names})
        results.append({})
        for n in names:
            v = np.sort(blocks[-1][n])
            q = int(p * 10_000 + 0.5)
            r = (10_000 - q) // 2
            results[-1][n] = np.array([v.mean(), v.std(ddof=1), v[r - 1], v[r + q - 1]])
        h = len(blocks)
        if h < 2:
            continue
        stable = True
        for n in names:
            u = np.concatenate([b[n] for b in blocks]).std(ddof=1)
            mantissa = f"{u:.{digits - 1}e}"
            delta = 0.5 * 10.0 ** (int(mantissa[mantissa.index("e") + 1 :]) - digits + 1)
            s = np.std([r[n] for r in results], axis=0, ddof=1) / math.sqrt(h)
            stable &= bool(np.all(2.0 * s <= delta))
        if stable:
            break
    return len(blocks), {n: np.concatenate([b[n] for b in blocks]) for n in names}


@pytest.mark.parametrize(("digits", "p"), [(1, 0.95), (2, 0.9)])
@pytest.mark.thorough
def test_an_adaptive_campaign_ends_where_the_standard_ends_it(tmp_path, digits, p):
    outputs = [Output("y"), Output("z")]
    options = {"coverage": p, "digits": digits}
    steps, values = clause_7_9_4(digits, p, 1_000_000)
    assert steps > 2 or digits == 1
    found = stream(curve, "adaptive", outputs, **options)
    assert found.adaptive is not None and found.adaptive.settled and found.adaptive.stable.all()
    assert (found.adaptive.steps, found.draws) == (steps, steps * 10_000)
    assert found.u[1] == pytest.approx(values["z"].std(ddof=1), rel=1e-9)
    assert found.interval("z", p) == coverage_interval(values["z"], p)
    assert all(np.all(2.0 * s <= found.adaptive.tolerance) for s in found.scatter)

    def breaking(first, count):
        if first == 15_000:
            raise OSError
        return curve(first, count)

    folder = {"folder": tmp_path, "fingerprint": "seed 11"}
    with pytest.raises(OSError):
        stream(breaking, "adaptive", outputs, chunk=1, **options, **folder)
    for _ in range(2):
        assert_same(stream(curve, "adaptive", outputs, **options, **folder), found)


def test_an_adaptive_campaign_says_that_it_reached_the_greatest_number():
    found = stream(curve, "adaptive", [Output("y"), Output("z")], most=25_500)
    assert found.adaptive is not None and not found.adaptive.settled
    assert (found.draws, found.adaptive.steps) == (25_500, 2)
    assert not found.interrupted
    np.testing.assert_array_equal(
        found.values[:, 1],
        np.concatenate([curve(first, 1000)["z"] for first in range(0, 26_000, 1000)])[:25_500],
    )


def test_precision_is_that_of_repeated_campaigns():
    def other(seed):
        def values(first, count):
            return {"y": np.random.default_rng([seed, first]).exponential(size=count)}

        return stream(values, 40_000, [Output("y")], block=10_000)

    campaigns = [other(seed) for seed in range(60)]
    results = np.array([[e.mean[0], e.u[0], *e.interval("y")] for e in campaigns])
    claimed = np.sqrt(np.mean([np.square(e.precision()) for e in campaigns], axis=0))[:, 0]
    # 60 campaigns tell a standard deviation to 9 %
    np.testing.assert_allclose(claimed, results.std(0, ddof=1), rtol=0.35)


def test_precision_for_another_probability_and_from_too_few_draws():
    found = stream(curve, 40_000, [Output("y"), Output("z")])
    again = stream(curve, 40_000, [Output("y"), Output("z")], coverage=0.8, kind="shortest")
    for own, other in zip(
        found.precision(0.8, "shortest"), again.precision(0.8, "shortest"), strict=True
    ):
        np.testing.assert_allclose(own, other, rtol=1e-12)
    few = stream(curve, 15_000, [Output("y")] + [Output("z")])
    assert all(np.isinf(s).all() for s in few.precision())
    assert np.isfinite(few.interval("y")).all()


# ---------------------------------------------------------------- bad input


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"draws": 1}, "draws: found 1, expected a whole number from 2"),
        ({"draws": 2.5}, "draws: found 2.5"),
        ({"draws": "many"}, "draws: found 'many'"),
        ({"draws": 2**33}, "draws: found"),
        ({"draws": "adaptive", "most": 0}, "draws: found 0"),
        ({"block": 0}, "found block = 0"),
        ({"step": 1}, "step: found 1, expected at least 2"),
        ({"draws": "adaptive", "step": 150}, "found 150, .* whole blocks of 100"),
        ({"chunk": 0}, "chunk = 0"),
        ({"coverage": 1.0}, "coverage probability: found 1.0"),
        ({"kind": "narrow"}, "found 'narrow', expected 'symmetric' or 'shortest'"),
        ({"digits": 3}, "digits: found 3"),
        ({"outputs": [], "fields": []}, "found no outputs"),
        ({"outputs": [Output("a"), Output("a")]}, "'a' is declared twice"),
        ({"outputs": [Output("a")]}, r"outputs \['a', 'b', 'map'\], expected \['a', 'map'\]"),
        ({"outputs": [Output("a", (2,)), Output("b", (2,))]}, r"'a': .* shape \(100,\)"),
        ({"fields": [Field("map", (4,))]}, r"'map': .*expected \(100, 4\)"),
    ],
)
def test_settings_that_make_no_sense_are_refused(changes, message):
    with pytest.raises(ValueError, match=message):
        run(**changes)


def test_further_mistakes_are_told(tmp_path):
    with pytest.raises(ValueError, match="needs a fingerprint"):
        run(folder=tmp_path)
    with pytest.raises(ValueError, match="needs a scalar output"):
        run("adaptive", outputs=())
    with pytest.raises(ValueError, match="found float32, expected float64"):
        stream(lambda first, n: {"y": np.zeros(n, np.float32)}, 100, [Output("y")])
    with pytest.raises(ValueError, match="quantiles of field 'map': found 1.0"):
        Field("map", (2,), (0.5, 1.0))
    found = run()
    with pytest.raises(ValueError, match=r"no scalar output is called 'b\[2\]' \(did you mean"):
        found.interval("b[2]")
    with pytest.raises(ValueError, match="expected more than 50000 for a coverage probability"):
        found.interval("a", 0.99999)
    with pytest.raises(ValueError, match="coverage probability: found 95"):
        found.interval("a", 95)
    with pytest.raises(ValueError, match="found kind 'widest'"):
        found.interval("a", kind="widest")
    with pytest.raises(ValueError, match="found probability 1.2"):
        found.quantile("a", 1.2)
