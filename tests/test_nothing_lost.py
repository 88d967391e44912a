"""Full disks, killed processes, outputs that go away: the earlier report is still there, what is
known is printed, and the next run works.
"""

import errno
import io
import json
import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from typer.testing import CliRunner

import vcal
from full_disk import EveryWrite, FullDisk, full_disk
from test_cli import run
from vcal import StudyError, files
from vcal.cli import app, interruption, output, session
from vcal.cli.so_far import SoFar
from vcal.report.html import folder as report_folder
from vcal.report.html.folder import Contents, ReportFolder, write_interrupted
from vcal.uncertainty import checkpoint
from vcal.uncertainty.checkpoint import STATE, Checkpoint

PLACE = ReportFolder("record.json", "test/", beside="draws")
LIVE = ReportFolder("record.json", "test/", beside="draws", live=True)
linux = pytest.mark.skipif(sys.platform != "linux", reason="looks into /proc")
posix = pytest.mark.skipif(os.name == "nt", reason="signals and locks of POSIX")


def publish(out, text, place=PLACE, names=("index.html", "table.csv")):
    contents = Contents({"schema": "test/1", "text": text}, {name: text * 9000 for name in names})
    return place.publish(out, lambda work: contents)


def contents(folder):
    return {
        str(path.relative_to(folder)): path.read_bytes()
        for path in sorted(folder.rglob("*"))
        if path.is_file()
    }


@pytest.fixture
def place(tmp_path):
    """A folder that holds a report, and other files that are to stay."""
    out = tmp_path / "home" / "report"
    publish(out, "first")
    (out / "notes.txt").write_text("mine")
    (out / "draws").mkdir()
    (out / "draws" / STATE).write_text("state")
    return out


# --- the folder of a report ----------------------------------------------------------------------


@linux
@pytest.mark.parametrize("kind", [PLACE, LIVE])
def test_a_full_disk_at_every_write_of_a_report(place, kind):
    before = contents(place)
    with full_disk(place.parent) as disk:
        publish(place, "first", kind)
    assert contents(place) == before and disk.count > 10
    for number in range(1, disk.count + 1):
        with full_disk(place.parent, number) as disk:
            try:
                publish(place, "second", kind)
            except OSError as error:
                assert error.errno == errno.ENOSPC
                assert str(error.filename).startswith(str(place))  # not a temporary name
            else:  # the step that failed has another way
                assert disk.failed
                publish(place, "first", kind)
        found = contents(place)
        assert found == before, number
        assert [p.name for p in place.parent.iterdir()] == ["report"]
    publish(place, "second", kind)
    assert contents(place)["table.csv"].startswith(b"second")


@linux
def test_a_full_disk_at_every_write_of_a_new_folder(tmp_path):
    with full_disk(tmp_path) as disk:
        run("init", tmp_path / "counted")
    for number in range(1, disk.count + 1):
        with full_disk(tmp_path, number):
            result = CliRunner().invoke(app, ["init", str(tmp_path / "study")])
        assert result.exit_code == 2 and result.stderr.count("\n") == 1
        assert f"{tmp_path / 'study'}" in result.stderr
        assert "No space left on device; make room there" in result.stderr
        assert [p.name for p in tmp_path.iterdir()] == ["counted"]
    run("init", tmp_path / "study")


@linux
@pytest.mark.parametrize("number", [errno.EROFS, errno.EACCES, errno.EDQUOT, errno.EIO])
def test_a_folder_that_cannot_be_written(tmp_path, number):
    out = tmp_path / "study"
    for at in (1, 2, 5):
        with full_disk(tmp_path, disk=FullDisk(tmp_path, at, number)):
            result = CliRunner().invoke(app, ["init", str(out)])
        assert result.exit_code == 2 and result.stderr.count("\n") == 1
        assert str(out) in result.stderr and os.strerror(number) in result.stderr
        assert not list(tmp_path.iterdir())


@linux
@pytest.mark.slow
def test_a_disk_that_is_really_full(study_of, tmp_path):
    """A file system of 128 KB, where that is allowed: the page of a check has more."""
    small = tmp_path / "small"
    small.mkdir()
    mounted = ["mount", "-t", "tmpfs", "-o", "size=128k", "tmpfs", str(small)]
    if (
        shutil.which("mount") is None
        or subprocess.run(mounted, capture_output=True, check=False).returncode
    ):
        pytest.skip("file systems cannot be mounted here")
    try:
        out = small / "out"
        found = CliRunner().invoke(app, ["check", str(study_of), "--out", str(out)])
        assert found.exit_code == 2 and "can be used" in found.stdout
        assert found.stderr.startswith(f"vcal: {out}") and found.stderr.count("\n") == 1
        assert "No space left on device; make room there" in found.stderr
        assert not list(small.iterdir())
        run("init", small / "study")  # what fits is written
    finally:
        subprocess.run(["umount", str(small)], check=True)


@linux
@pytest.mark.thorough
def test_every_write_of_commands_that_take_a_second(study_of, tmp_path):
    """`benchmarks/disk_full.py` does it for all commands."""
    for number, (words, said_before) in enumerate(
        [
            (["check", str(study_of)], "can be used"),
            (["simulate", str(study_of)], ""),
            (["effects", "backlash"], ""),
        ]
    ):
        home = tmp_path / str(number)
        home.mkdir()
        out = home / "out"
        disk = EveryWrite(home)
        with full_disk(home, disk=disk):
            found = CliRunner().invoke(app, [*words, "--out", str(out)])
        said, left = found.stderr, [path.name for path in home.iterdir()]
        if disk.forked:
            disk.answer([found.exit_code, said, left, found.stdout])
        assert found.exit_code == 0 and disk.count > 8
        assert sorted(disk.answers) == list(range(1, disk.count + 1))
        for code, said, left, shown in disk.answers.values():
            assert (code, said.count("\n"), left) == (2, 1, []) and str(out) in said
            assert said_before in shown


def forked(action):
    """Exit code of a process that does something and ends."""
    import warnings

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        number = os.fork()
    if number == 0:
        try:
            action()
        except BaseException:
            os._exit(1)
        os._exit(0)
    return os.waitstatus_to_exitcode(os.waitpid(number, 0)[1])


@posix
@pytest.mark.parametrize("kind", [PLACE, pytest.param(LIVE, marks=pytest.mark.slow)])
def test_a_kill_between_any_two_steps(place, kind, monkeypatch):
    before = contents(place)
    names = ("index.html", "table.csv", "more.csv")

    def dying(real, left):
        def call(*arguments, **keys):
            for step in (0, 1):
                left[0] -= 1
                if left[0] == 0:
                    os._exit(9)
                if step == 0:
                    result = real(*arguments, **keys)
            return result

        return call

    def publish_and_die(steps):
        left = [steps]
        for name in ("replace", "rename", "link", "unlink", "mkdir", "rmdir"):
            monkeypatch.setattr(os, name, dying(getattr(os, name), left))
        monkeypatch.setattr(report_folder, "exchange", dying(files.exchange, left))
        publish(place, "second", kind, names)

    ends, steps = set(), 0
    while (code := forked(lambda steps=steps: publish_and_die(steps))) == 9 or not steps:
        found = contents(place)
        kept = {name: found.pop(name) for name in ("notes.txt", f"draws{os.sep}{STATE}")}
        assert kept == {name: before[name] for name in kept}
        texts = {data[:5] for name, data in found.items() if name != "record.json"}
        if kind is PLACE:  # one or the other, never parts of both
            assert len(texts) == 1 and json.loads(found["record.json"])["text"] in (
                "first",
                "second",
            )
            assert (b"secon" in texts) == ("more.csv" in found)
        assert "record.json" in found and texts <= {b"first", b"secon"}
        ends |= texts
        publish(
            place, "first", kind
        )  # the next run works, and finds nothing that it may not replace
        assert contents(place) == before
        assert [p.name for p in place.parent.iterdir()] == ["report"]
        steps += 1
    assert code == 0 and steps > 5 and ends == {b"first", b"secon"}


def test_what_is_known_lies_beside_the_report_until_the_next_one(place):
    write_interrupted(place, {"schema": "vcal-interrupted/1", "effects": []})
    assert "interrupted.json" in contents(place)
    publish(place, "second")
    found = contents(place)
    assert "interrupted.json" not in found and found["notes.txt"] == b"mine"
    (place / "interrupted.json").write_text("{}")  # a file of the user's own
    publish(place, "third")
    assert contents(place)["interrupted.json"] == b"{}"
    alone = place.parent / "alone"
    write_interrupted(alone, {"schema": "vcal-interrupted/1", "effects": []})
    publish(alone, "first")
    assert "interrupted.json" not in contents(alone)


def test_without_an_exchange_in_one_step(place, monkeypatch):
    monkeypatch.setattr(report_folder, "exchange", lambda *folders: False)
    publish(place, "second", names=("index.html",))
    found = contents(place)
    assert found["index.html"].startswith(b"second") and "table.csv" not in found
    assert found["notes.txt"] == b"mine" and "replaces_sha256" not in found["record.json"].decode()


def test_a_folder_in_which_the_user_is_stays_the_same(place, monkeypatch):
    monkeypatch.chdir(place)
    publish(Path("."), "second")
    assert (Path(".") / "index.html").read_text().startswith("second")
    assert place.stat().st_ino == Path(".").stat().st_ino


def test_the_verdict_is_told_where_the_report_cannot_be_written(study_of, tmp_path, monkeypatch):
    def full(*arguments, **keys):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(tmp_path / "out" / "a.png"))

    closure = SimpleNamespace(interrupted=False)
    monkeypatch.setattr(vcal.study.close_study, "close_loop", lambda *args, **keys: closure)
    monkeypatch.setattr(vcal.fleet.one_study, "write_report", full)
    monkeypatch.setattr(vcal.cli.show, "show_closure", lambda closure: print("a sentence"))
    shown = run("loop", study_of, "--out", tmp_path / "out", code=2)
    assert shown.stdout == "a sentence\n"
    told = f"vcal: {tmp_path / 'out' / 'a.png'}: No space left on device; make room there"
    assert shown.stderr.startswith(told) and shown.stderr.count("\n") == 1


@pytest.fixture
def study_of(small_tracker_study, monkeypatch):
    monkeypatch.setenv("VCAL_NO_CACHE", "1")
    return small_tracker_study


@pytest.mark.parametrize(
    "error",
    [
        MemoryError("Unable to allocate 8.0 GiB for an array"),
        type("XlaRuntimeError", (RuntimeError,), {})(
            "RESOURCE_EXHAUSTED: Out of memory allocating 9 bytes"
        ),
    ],
)
def test_too_little_memory(study_of, tmp_path, monkeypatch, error):
    def fails(*arguments, **keys):
        raise error

    monkeypatch.setattr(vcal.study.close_study, "close_loop", fails)
    told = run("loop", study_of, "--out", tmp_path / "out", code=2).stderr
    assert told.startswith("vcal: memory: found too little of it for ") and told.count("\n") == 1


# --- checkpoints ---------------------------------------------------------------------------------


def counts_of(rng, draws, k=40, bins=4096):
    found = np.zeros((k, bins), np.uint32)
    for row in found:
        np.add.at(row, np.clip(rng.normal(bins / 2, bins / 9, draws), 0, bins - 1).astype(int), 1)
    return found


def test_a_checkpoint_writes_what_is_new(tmp_path):
    rng, folder = np.random.default_rng(0), tmp_path / "draws"
    one, counts, written = Checkpoint(folder, {"seed": 1}), np.zeros((40, 4096), np.uint32), 0
    assert one.load() is None
    for save in range(1, 41):
        before = {p.name for p in folder.iterdir()}
        counts = counts + counts_of(rng, 50)
        one.save({"draws": np.array(50 * save), "sketch.counts": counts, "x": np.ones(3)}, [])
        fresh = [p for p in folder.iterdir() if p.name not in before or p.name == STATE]
        written += sum(p.stat().st_size for p in fresh)
        again = Checkpoint(folder, {"seed": 1})
        one.release()
        held = again.load()
        np.testing.assert_array_equal(held.arrays["sketch.counts"], counts)
        assert held.arrays["sketch.counts"].dtype == np.uint32 and held.arrays["draws"] == 50 * save
        one = again  # a resumed campaign goes on as the first one would have
    assert written < 0.25 * 40 * counts.nbytes
    assert sum(p.stat().st_size for p in folder.iterdir()) < 2.5 * counts.nbytes
    one.release()


@posix
def test_two_processes_do_not_share_a_campaign(tmp_path):
    one = Checkpoint(tmp_path, {"seed": 1})
    one.load()
    with pytest.raises(StudyError, match="another process that runs this campaign"):
        Checkpoint(tmp_path, {"seed": 1}).load()
    one.release()
    two = Checkpoint(tmp_path, {"seed": 1})
    two.load()
    two.release()
    assert not list(tmp_path.iterdir())


@linux
def test_a_full_disk_at_every_write_of_a_checkpoint(tmp_path):
    counts = np.arange(4000, dtype=np.uint32).reshape(2, -1)

    def save(one, step):
        arrays = {"draws": np.array(10 * step), "sketch.counts": counts * step, "x": np.ones(step)}
        one.save(arrays, [np.full((10, 2), float(i)) for i in range(step)])

    number = 0
    while True:
        number += 1
        folder = tmp_path / str(number)
        one = Checkpoint(folder, {"seed": 1})
        one.load()
        save(one, 1)
        with full_disk(folder, number) as disk:
            try:
                save(one, 2)
            except OSError as error:
                assert str(error.filename).startswith(str(folder))
        again = Checkpoint(folder, {"seed": 1})
        one.release()
        held = again.load()
        done = 1 if disk.failed else 2
        assert held.arrays["draws"] == 10 * done and len(held.kept) == done
        np.testing.assert_array_equal(held.arrays["sketch.counts"], counts * done)
        save(again, 3)  # there is room again
        again.release()
        last = Checkpoint(folder, {"seed": 1})
        np.testing.assert_array_equal(last.load().arrays["sketch.counts"], counts * 3)
        last.release()
        if not disk.failed:
            break
    assert number > 5


@pytest.mark.parametrize(
    "change",
    [
        {"arrays": [["x", "O", [3]]]},
        {"arrays": [["x", "<f8", [-3]]]},
        {"arrays": [["x", "<f8", [2**60]]]},
        {"arrays": [["x", "no", [3]]]},
        {"arrays": 5},
        {"parts": [{"file": "../../precious", "sha256": ""}]},
        {"parts": [{"file": 5}]},
        {"parts": None},
        {"sha256": None},
    ],
)
def test_a_signed_state_is_checked_all_the_same(tmp_path, change):
    one = Checkpoint(tmp_path, {"seed": 1})
    one.load()
    one.save({"draws": np.array(3), "x": np.ones(3)}, [])
    one.release()
    path = tmp_path / STATE
    line, _, rest = path.read_bytes().partition(b"\n")
    header = json.loads(line.partition(b" ")[2]) | change
    line = json.dumps(header).encode()
    path.write_bytes(
        checkpoint.hashlib.sha256(line).hexdigest().encode() + b" " + line + b"\n" + rest
    )
    with pytest.raises(StudyError, match="was cut or edited"):
        Checkpoint(tmp_path, {"seed": 1}).load()


# --- standard output -----------------------------------------------------------------------------


def command(*arguments, **keys):
    package = str(Path(vcal.__file__).parents[1])
    return subprocess.Popen(
        [sys.executable, "-m", "vcal", *map(str, arguments)],
        env={**os.environ, "PYTHONPATH": package, "VCAL_NO_CACHE": "1"},
        text=True,
        **keys,
    )


@linux
def test_an_output_that_is_full(tmp_path):
    with open("/dev/full", "w") as full:
        begun = command("init", tmp_path / "study", stdout=full, stderr=subprocess.PIPE)
        _, told = begun.communicate(timeout=120)
    assert begun.returncode == 2 and (tmp_path / "study" / "setup.toml").is_file()
    assert told.startswith(
        "vcal: standard output: No space left on device; the text follows here\n"
    )
    assert f"Wrote {tmp_path / 'study'}" in told and "Traceback" not in told


class Broken(io.StringIO):
    """A stream whose reader has gone."""

    def __init__(self, number=errno.EPIPE):
        super().__init__()
        self.number = number

    def write(self, text):
        raise OSError(self.number, os.strerror(self.number))

    def fileno(self):
        raise io.UnsupportedOperation


@pytest.mark.parametrize("number", [errno.EPIPE, errno.ENOSPC, errno.EIO])
def test_an_output_that_goes_away(monkeypatch, number):
    """Where there is more to do than to print, the text goes on to stderr after one message."""
    ended, other = [], io.StringIO()
    monkeypatch.setattr(output, "leave", ended.append)
    monkeypatch.setattr(output._STATE, "lost", False)
    output.more_to_do(True)
    stream = output._Guarded(Broken(number), other)
    stream.writelines(["one\n", "two\n"])
    stream.flush()
    told = f"vcal: standard output: {os.strerror(number)}; the text follows here\n"
    assert other.getvalue() == f"{told}one\ntwo\n" and output.lost() and not ended
    output.more_to_do(False)
    output._Guarded(Broken(number), io.StringIO()).write("a list of which nobody reads the rest")
    assert ended == ([128 + 13] if number == errno.EPIPE else [])


@pytest.mark.slow
def test_compiled_programs_that_were_cut(tmp_path):
    """A process that was killed while it wrote a program, or another one that writes it now."""
    script = (
        "import sys, jax, jax.numpy as jnp, vcal\n"
        "vcal.enable_float64()\n"
        "jax.config.update('jax_persistent_cache_min_compile_time_secs', 0.0)\n"
        "print(jax.jit(lambda x: jnp.sin(x) @ x)(jnp.arange(5.0)))\n"
    )
    package, cache = str(Path(vcal.__file__).parents[1]), tmp_path / "cache"
    keys = {"PYTHONPATH": package, "XDG_CACHE_HOME": str(cache)}
    plain = {k: v for k, v in os.environ.items() if k not in ("VCAL_NO_CACHE",)}
    plain = {k: v for k, v in plain.items() if not k.startswith("JAX_")} | keys
    first = None
    for size in (None, 100, 0):
        programs = [path for path in cache.rglob("*-cache") if path.is_file()]
        assert bool(programs) == (first is not None)
        for path in programs:
            path.write_bytes(path.read_bytes()[:size])
        done = subprocess.run(
            [sys.executable, "-c", script], env=plain, capture_output=True, text=True, check=True
        )
        assert first in (None, done.stdout) and not done.stderr
        first = done.stdout


# --- signals -------------------------------------------------------------------------------------


@posix
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_ends_what_does_not_listen(tmp_path, number):
    """Compiled code runs for many seconds without a look at signals: here a lock stands for it."""
    script = (
        "import ctypes, signal\n"
        "from vcal.cli import interruption\n"
        "signal.signal(signal.SIGINT, signal.default_int_handler)\n"  # whatever it is here
        "interruption.listen()\n"
        "interruption.keep(lambda: 'interrupted: what is known is written')\n"
        "for number in (signal.SIGINT, signal.SIGTERM):\n"
        "    signal.signal(number, lambda *of: None)\n"  # lost, as in a callback
        "print('ready', flush=True)\n"
        "while True:\n"
        "    ctypes.CDLL(None).sleep(60)\n"  # without the interpreter, as the compiler is
    )
    begun = subprocess.Popen(
        [sys.executable, "-c", script], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
        env={**os.environ, "PYTHONPATH": str(Path(vcal.__file__).parents[1])},
    )  # fmt: skip
    assert begun.stdout.readline() == "ready\n"
    began = time.monotonic()
    begun.send_signal(number)
    _, told = begun.communicate(timeout=30)
    assert begun.returncode == 128 + number
    assert told == "vcal: interrupted: what is known is written\n"
    assert time.monotonic() - began < 5  # 1 s and a little, on a machine that is busy


def test_the_effects_so_far_are_written(tmp_path):
    out = tmp_path / "report"
    try:
        so_far = SoFar(out, "vcal loop ...")
        assert interruption.saved() == "interrupted; nothing was written"
        so_far = SoFar(out, "vcal loop ...")
        found = {"effect": "backlash", "placement": "Y", "p_value": 0.001, "parameters": []}
        so_far.known([found])
        assert interruption.saved() == (
            f"interrupted: 1 effect found so far (backlash Y), in {out / 'interrupted.json'}"
        )
        content = json.loads((out / "interrupted.json").read_text())
        assert content["effects"] == [found] and content["schema"] == "vcal-interrupted/1"
        so_far.written()
        assert "is complete" in interruption.saved()
    finally:
        interruption.keep(None)


def test_a_full_disk_has_a_remedy():
    error = OSError(errno.ENOSPC, "No space left on device")
    assert session._of_system(error).startswith("a file: No space left")
    assert session._of_system(OSError(errno.EINTR, "x")) is None
