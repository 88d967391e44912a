"""Studies from somebody else: none runs, reads or writes anything that it should not, and each ends
in one message.
"""

import io
import json
import os
import shutil
import socket
import zipfile
from pathlib import Path
from types import SimpleNamespace

import pytest

import vcal
from test_cli import refused, run
from test_urdf import URDF
from vcal import StudyError, load_study
from vcal.numerics import program_cache
from vcal.report.html.folder import ReportFolder
from vcal.study.consent import settings_file, trusted_folders
from vcal.study.reading import unpacked
from vcal.study.urdf import chain_from_urdf
from vcal.user_files import is_own

SECRET = "root:x:0:0:the secret of this machine:/root:/bin/sh"
LONGEST = 1500
posix = pytest.mark.skipif(os.name == "nt", reason="devices, links and owners of POSIX")


@pytest.fixture
def study(small_tracker_study, monkeypatch):
    monkeypatch.setenv("VCAL_NO_CACHE", "1")
    return small_tracker_study


@pytest.fixture
def mark(tmp_path):
    """A file that code of a study makes where it is run."""
    return tmp_path / "it-was-run"


@pytest.fixture
def secret(tmp_path):
    """A file of the user outside of every study."""
    path = tmp_path / "secret.txt"
    path.write_text(f"{SECRET}\n{SECRET}\n")
    return path


@pytest.fixture(autouse=True)
def own_home(tmp_path_factory, monkeypatch):
    """Settings and memory of a user who has trusted nothing yet."""
    home = tmp_path_factory.mktemp("home")
    monkeypatch.setenv("XDG_CONFIG_HOME", str(home / "config"))
    monkeypatch.setenv("XDG_STATE_HOME", str(home / "state"))
    return home


def told(*arguments):
    """The one message of a refused command, which shows no control character and no secret."""
    text = refused(*arguments)
    assert text.count("\n") == 1 and len(text) < LONGEST
    assert "secret" not in text.replace("secret.txt", "")
    assert all(c.isprintable() for c in text.strip("\n"))
    return text


def change(study, old, new, count=1):
    setup = study / "setup.toml"
    text = setup.read_text(encoding="utf-8")
    assert old in text
    setup.write_text(text.replace(old, new, count), encoding="utf-8")


def code(path, mark):
    """A Python file that leaves a mark where it is run."""
    path.write_text(
        f"import pathlib\npathlib.Path({str(mark)!r}).write_text('run')\n"
        "from vcal.effects import Effect\n\n\nclass Own(Effect):\n    pass\n"
    )
    return path


# --- code ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("key", ["model.effects_file", "instrument.kind_file"])
@pytest.mark.parametrize("command", ["check", "loop", "uncertainty", "design", "simulate"])
def test_code_is_not_run_without_consent(study, mark, tmp_path, key, command):
    code(study / "mine.py", mark)
    out = () if command == "check" else ("--out", tmp_path / "out")
    text = told(command, study, *out, "--set", f"{key}=mine.py")
    assert "mine.py, file: found Python code" in text and "--trust" in text
    assert not mark.exists() and not (tmp_path / "out").exists()


@pytest.mark.parametrize("command", ["compensate", "verify", "certificate"])
def test_no_other_command_runs_it(study, mark, tmp_path, command):
    code(study / "mine.py", mark)
    more = {"compensate": ("--to", "csv"), "verify": (), "certificate": ()}[command]
    out = () if command == "verify" else ("--out", tmp_path / "out")
    text = told(command, study, *more, *out, "--set", "model.effects_file=mine.py")
    assert "--trust" in text and not mark.exists()


def test_a_page_of_a_refused_study_runs_nothing(study, mark, tmp_path):
    code(study / "mine.py", mark)
    result = run(
        "check", study, "--out", tmp_path / "out", "--set", "instrument.kind_file=mine.py", code=2
    )
    assert "--trust" in result.stderr and not mark.exists()


def test_code_of_a_family_is_not_run(few_poses, mark, tmp_path):
    folder = tmp_path / "balls"
    shutil.copytree(few_poses, folder)
    text = (folder / "setup.toml").read_text()
    (folder / "other.toml").write_text(
        text.replace("[instrument]", '[instrument]\nkind_file = "mine.py"', 1)
    )
    code(folder / "mine.py", mark)
    text = told(
        "design", folder, "--out", tmp_path / "out", "--set", 'design.families=["other.toml"]'
    )
    assert "mine.py" in text and "--trust" in text and not mark.exists()
    text = told(
        "design", folder, "--out", tmp_path / "out", "--set", 'design.families=["../x.toml"]'
    )
    assert "outside the folder" in text


def test_bytecode_beside_trusted_code_is_not_run(study, mark):
    """A reader looks at the file; what lies in __pycache__ nobody reads."""
    good = study / "mine.py"
    good.write_text("raise ValueError('harmless')\n")
    import importlib.util
    import marshal

    bad = compile(f"open({str(mark)!r}, 'w').close()", "mine.py", "exec")
    cached = Path(importlib.util.cache_from_source(str(good)))
    cached.parent.mkdir(parents=True, exist_ok=True)
    found = good.stat()
    header = importlib.util.MAGIC_NUMBER + bytes(4)
    header += int(found.st_mtime).to_bytes(4, "little") + found.st_size.to_bytes(4, "little")
    cached.write_bytes(header + marshal.dumps(bad))
    text = told("check", study, "--trust", "--set", "model.effects_file=mine.py")
    assert "harmless" in text and not mark.exists()


def test_consent_holds_for_the_same_contents_at_the_same_path(study, mark, tmp_path):
    code(study / "mine.py", mark)
    given = ["model.effects_file=mine.py"]
    with pytest.raises(StudyError, match="derived from|Own"):  # it was run: its class is unusable
        load_study(study, given, trust=True)
    assert mark.exists()
    mark.unlink()
    with pytest.raises(StudyError, match="derived from|Own"):
        load_study(study, given)
    assert mark.exists()
    mark.unlink()
    other = tmp_path / "copy"
    shutil.copytree(study, other)
    with pytest.raises(StudyError, match="repeat the command with --trust"):
        load_study(other, given)
    with (study / "mine.py").open("a") as file:
        file.write("# changed\n")
    with pytest.raises(StudyError, match="repeat the command with --trust"):
        load_study(study, given)
    assert not mark.exists()


def write_settings(text):
    file = settings_file()
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_text(text)
    return file


def test_folders_that_the_user_trusts(study, mark, tmp_path):
    code(study / "mine.py", mark)
    given = ["model.effects_file=mine.py"]
    write_settings(f"trusted = [{str(tmp_path / 'elsewhere')!r}]\n")
    with pytest.raises(StudyError, match="--trust"):
        load_study(study, given)
    assert not mark.exists()
    write_settings(f"trusted = [{str(study)!r}]\n")
    with pytest.raises(StudyError, match="derived from|Own"):
        load_study(study, given)
    assert mark.exists()


def test_settings_in_a_study_give_no_consent(study, mark, monkeypatch):
    code(study / "mine.py", mark)
    for name in ("config.toml", "vcal.toml", ".vcal.toml"):
        (study / name).write_text(f"trusted = [{str(study)!r}]\n")
    monkeypatch.chdir(study)
    assert "--trust" in told("check", ".", "--set", "model.effects_file=mine.py")
    with pytest.raises(StudyError, match="trusted"):
        load_study(study, ["trusted=true"])
    assert not mark.exists()


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("trusted = [", "found what is not TOML"),
        ("trusted = 'a'", "a list of absolute paths"),
        ("trusted = ['a']", "a list of absolute paths"),
        ("trust = ['/a']", "key trust"),
    ],
)
def test_settings_that_cannot_be_used(study, mark, text, message):
    code(study / "mine.py", mark)
    file = write_settings(text)
    found = told("check", study, "--set", "model.effects_file=mine.py")
    assert message in found and str(file) in found and not mark.exists()


@posix
def test_settings_that_others_may_write_are_not_used(study, mark):
    code(study / "mine.py", mark)
    write_settings(f"trusted = [{str(study)!r}]\n").chmod(0o666)
    with pytest.raises(StudyError, match="others may write"):
        trusted_folders()
    assert "others may write" in told("check", study, "--set", "model.effects_file=mine.py")
    assert not mark.exists()


@pytest.mark.parametrize("way", ["absolute", "above", "link"])
def test_code_outside_is_not_run_even_with_trust(study, mark, tmp_path, way):
    outside = code(tmp_path / "evil.py", mark)
    name = {"absolute": str(outside), "above": "../evil.py", "link": "mine.py"}[way]
    if way == "link":
        (study / "mine.py").symlink_to(outside)
    for more in ((), ("--trust",), ("--trust", "--allow-outside")):
        text = told("check", study, *more, "--set", f'model.effects_file="{name}"')
        assert "outside the folder of the study" in text
    assert not mark.exists()
    write_settings(f"trusted = [{str(tmp_path)!r}]\n")
    with pytest.raises(StudyError, match="derived from|Own"):
        load_study(study, [f'model.effects_file="{name}"'])
    assert mark.exists()


@posix
def test_programs_that_others_may_write_are_not_run(tmp_path, monkeypatch):
    """A compiled program that is read from the cache is run."""
    folder, set_to = tmp_path / "cache", {}
    config = SimpleNamespace(jax_compilation_cache_dir=None, update=set_to.__setitem__)
    monkeypatch.setattr(program_cache.jax, "config", config)
    monkeypatch.setattr(program_cache, "cache_folder", lambda: folder)

    def used():
        set_to.clear()
        program_cache.keep_programs()
        return set_to.get("jax_compilation_cache_dir") == str(folder)

    assert used() and folder.stat().st_mode & 0o777 == 0o700
    program = folder / "program"
    program.write_bytes(b"mine")
    program.chmod(0o666)
    assert used()  # nobody else reaches it
    folder.chmod(0o755)
    assert not used()
    program.chmod(0o644)
    assert used()
    folder.chmod(0o775)
    assert not used()
    folder.chmod(0o700)
    program.unlink()
    program.symlink_to(tmp_path)
    assert not used()
    program.unlink()
    tmp_path.chmod(0o777)
    assert not used() and not is_own(folder)
    tmp_path.chmod(0o1777)
    assert used()
    tmp_path.chmod(0o700)
    monkeypatch.setattr(os, "getuid", lambda: 12345)
    assert not used()  # it belongs to another user


# --- paths, links, devices -----------------------------------------------------------------------

NAMES = ["instrument.table", "data.table", "model.geometric.table"]


@pytest.mark.parametrize("way", ["absolute", "above", "link", "folder"])
def test_tables_outside_are_not_read(study, secret, tmp_path, way):
    names = {
        "absolute": str(secret),
        "above": "../secret.txt",
        "link": "it.csv",
        "folder": "sub/secret.txt",
    }
    if way == "link":
        (study / "it.csv").symlink_to(secret)
    if way == "folder":
        (study / "sub").symlink_to(tmp_path)
    for key in ("data.check", "model.geometric.table"):
        text = told("check", study, "--set", f'{key}="{names[way]}"')
        assert "outside the folder of the study" in text and "--allow-outside" in text
    text = told("check", study, "--allow-outside", "--set", f'data.check="{names[way]}"')
    assert "text without columns of numbers" in text  # and none of its contents, see `told`


def test_tables_outside_are_read_where_that_is_allowed(study, tmp_path):
    shutil.move(study / "errors.csv", tmp_path / "shared.csv")
    given = ["model.geometric.table=../shared.csv"]
    with pytest.raises(StudyError, match="allow_outside=True"):
        load_study(study, given)
    assert load_study(study, given, allow_outside=True).allow_outside
    (study / "errors.csv").symlink_to(tmp_path / "shared.csv")
    with pytest.raises(StudyError, match="a link that leads outside"):
        load_study(study)


@pytest.mark.parametrize(
    "name", ["", ".", "..", "a\0b", "x" * 5000, "CON", "sub/../data.csv", "~/x"]
)
def test_names_of_files_that_are_none(study, name):
    with pytest.raises(StudyError) as error:
        load_study(study, {"data.check": name})
    assert "secret" not in str(error.value) and "Traceback" not in str(error.value)


@posix
def test_devices_pipes_and_sockets_are_not_opened(study):
    os.mkfifo(study / "pipe.csv")
    made = socket.socket(socket.AF_UNIX)
    here = os.getcwd()
    os.chdir(study)  # the path of a socket is short
    made.bind("socket.csv")
    os.chdir(here)
    for name in ("pipe.csv", "socket.csv"):
        assert "a device, a pipe or a socket" in told("check", study, "--set", f"data.check={name}")
    (study / "zero.csv").symlink_to("/dev/zero")
    assert "outside the folder" in told("check", study, "--set", "data.check=zero.csv")
    allowed = told("check", study, "--allow-outside", "--set", "data.check=zero.csv")
    assert "a device, a pipe or a socket" in allowed
    (study / "round.csv").symlink_to("round.csv")
    assert "no such file" in told("check", study, "--set", "data.check=round.csv")
    made.close()


@posix
def test_a_study_file_that_is_a_link(study, secret):
    (study / "setup.toml").rename(study.parent / "real.toml")
    (study / "setup.toml").symlink_to(secret)
    assert "outside the folder" in told("check", study)
    assert "what is not TOML" in told("check", study, "--allow-outside")


@pytest.mark.parametrize("key", ["urdf", "from"])
def test_other_files_stay_inside(study, secret, key):
    if key == "from":
        given = ["model.from=../secret.txt"]
    else:
        given = ["machine.urdf=../secret.txt"]
    with pytest.raises(StudyError) as error:
        load_study(study, given)
    assert "the secret" not in str(error.value)


@pytest.mark.parametrize("way", ["absolute", "above", "link", "folder"])
def test_an_import_reads_the_machine_of_a_study_inside_its_folder(tmp_path, secret, way):
    """`--machine STUDY` takes a machine of somebody else, with the file that it names."""
    study = tmp_path / "theirs"
    study.mkdir()
    robot = tmp_path / "robot.urdf"
    robot.write_text(URDF)
    name = {"absolute": str(robot), "above": "../robot.urdf", "link": "it.urdf"}.get(way)
    if way == "link":
        (study / name).symlink_to(robot)
    text = f"[machine]\nurdf = {json.dumps(name or 'robot.urdf')}\ntip_link = 'flange'\n"
    (study / "setup.toml").write_text(text)
    if way == "folder":  # the study file itself
        shutil.move(study / "setup.toml", tmp_path / "setup.toml")
        (study / "setup.toml").symlink_to(tmp_path / "setup.toml")
        shutil.move(robot, study / "robot.urdf")
    export = tmp_path / "poses.csv"
    head = "q1 [m],q2 [rad],q3 [rad],q4 [rad],x [mm],y [mm],z [mm]"
    export.write_text(f"{head}\n0,0,0,0,1.5,2.5,3.5\n1,1,1,1,4.5,5.5,6.5\n")
    words = ("import", export, "--machine", study, "--out", tmp_path / "out")
    found = told(*words)
    assert "outside the folder of the study" in found and "--allow-outside" in found
    assert "outside" not in told(*words, "--allow-outside")  # what is missing is the readings
    (study / "setup.toml").unlink()
    (study / "setup.toml").symlink_to(secret)
    assert "what is not TOML" in told(*words, "--allow-outside")


# --- what is written -----------------------------------------------------------------------------


@posix
def test_links_in_the_folder_of_a_report_are_not_followed(tmp_path):
    precious = tmp_path / "precious.txt"
    precious.write_text("precious")
    out, place = tmp_path / "report", ReportFolder("record.json", "test/")

    def write(text):
        def make(work):
            (work / "index.html").write_text(text)
            return place.write(work, contents)

        from vcal.report.html.folder import Contents

        contents = Contents({"schema": "test/1"}, {"index.html": text})
        place.fill(out, make)

    write("first")
    (out / "index.html").unlink()
    (out / "index.html").symlink_to(precious)
    with pytest.raises(StudyError, match="not as the earlier report left it"):
        write("second")
    assert precious.read_text() == "precious"
    record = json.loads((out / "record.json").read_text())
    assert record["files"] == ["index.html", "record.json"]


def test_a_simulation_copies_nothing_outside(study, tmp_path):
    shutil.copy(study / "errors.csv", tmp_path / "errors.csv")
    change(study, "errors.csv", "../errors.csv")
    text = told("simulate", study, "--out", tmp_path / "made", "--allow-outside")
    assert "outside the folder of the study" in text
    assert sorted(p.name for p in tmp_path.iterdir()) == sorted(["errors.csv", study.name])


# --- archives and sizes --------------------------------------------------------------------------


def archive(**files):
    data = io.BytesIO()
    with zipfile.ZipFile(data, "w", zipfile.ZIP_DEFLATED) as made:
        for name, content in files.items():
            made.writestr(name, content)
    return data.getvalue()


def test_a_spreadsheet_that_is_gigabytes_when_it_is_unpacked(study, monkeypatch):
    monkeypatch.setattr(unpacked, "_LARGEST", 1 << 20)
    bomb = archive(**{"xl/worksheets/sheet1.xml": b" " * (3 << 20)})
    assert len(bomb) < 10_000
    (study / "bomb.xlsx").write_bytes(bomb)
    assert "when it is unpacked" in told("check", study, "--set", "data.check=bomb.xlsx")
    # One that states a small size.
    size = (3 << 20).to_bytes(4, "little")
    assert bomb.count(size) == 2
    (study / "bomb.xlsx").write_bytes(bomb.replace(size, (100).to_bytes(4, "little")))
    assert "when it is unpacked" in told("check", study, "--set", "data.check=bomb.xlsx")


def test_a_spreadsheet_of_two_cells_a_million_rows_apart(study):
    openpyxl = pytest.importorskip("openpyxl")
    book = openpyxl.Workbook()
    book.active["A1"], book.active["XFD1048576"] = "x_mm", 1.0
    book.save(study / "wide.xlsx")
    assert "spans 1048576 rows" in told("check", study, "--set", "data.check=wide.xlsx")


def test_an_archive_with_paths_that_lead_out(study, tmp_path):
    (study / "slip.xlsx").write_bytes(archive(**{"../../slipped.txt": b"x"}))
    told("check", study, "--set", "data.check=slip.xlsx")
    assert (
        not (tmp_path / "slipped.txt").exists() and not (tmp_path.parent / "slipped.txt").exists()
    )


def test_entities_of_xml_are_not_expanded(study, secret):
    (study / "arm.urdf").write_text(
        f'<!DOCTYPE robot [<!ENTITY x SYSTEM "{secret.as_uri()}">]><robot name="&x;"/>'
    )
    with pytest.raises(StudyError, match="a document type declaration") as error:
        chain_from_urdf(study / "arm.urdf", "arm.urdf", "setup.toml")
    assert "the secret" not in str(error.value)


def test_a_sparse_file_of_many_gigabytes(study):
    with (study / "large.csv").open("wb") as file:
        file.truncate(8 << 30)
    assert "8.0 GiB" in told("check", study, "--set", "data.check=large.csv")


def test_pickles_are_not_unpickled(study, mark):
    import pickle

    class Evil:
        def __reduce__(self):
            return open, (str(mark), "w")

    data = pickle.dumps(Evil())
    for name in ("evil.csv", "evil.npy", "evil.parquet"):
        (study / name).write_bytes((b"PAR1" if "parquet" in name else b"") + data)
        told("check", study, "--set", f"data.check={name}")
    assert not mark.exists()


# --- texts ---------------------------------------------------------------------------------------

MARKUP = "<script>alert(1)</script><img src=x onerror=alert(1)>"
CONTROL = "\\u001b[2J\\u001b]0;owned\\u0007\\u202e"


def test_control_characters_of_names_are_shown_escaped(study):
    for key in ("name", "model.geometric.family", "instrument.kind", "data.table"):
        result = run(
            "check", study, "--set", f'{key}="a{CONTROL}b"', code=0 if key == "name" else 2
        )
        shown = result.output
        assert "\x1b" not in shown and "\x07" not in shown and "\u202e" not in shown
        assert "\\x1b[2J" in shown or "\\u001b" in shown


def test_control_characters_of_cells_are_shown_escaped(study):
    table = study / "data.csv"
    lines = table.read_text().splitlines()
    lines[3] = ",".join(["\x1b[2J\x1b]0;owned\x07", *lines[3].split(",")[1:]])
    table.write_text("\n".join(lines) + "\n")
    assert "\\x1b" in told("check", study)
    lines[0] = lines[0].replace("range_mm", "\x1b[31mrange")
    table.write_text("\n".join(lines) + "\n")
    assert "\x1b" not in run("check", study, code=2).output


def test_markup_in_texts_is_text_in_pages(study, tmp_path):
    run("check", study, "--out", tmp_path / "out", "--set", f'name="{MARKUP}"')
    page = (tmp_path / "out" / "index.html").read_text()
    assert "<script>alert" not in page and "<img src=x" not in page
    assert "&lt;script&gt;alert(1)" in page


@pytest.mark.parametrize(
    "cell", ["=1+1", "=HYPERLINK('http://x')", "@SUM(A1)", "+cmd|' /C calc'!A0"]
)
def test_formulas_in_cells_are_no_numbers(study, cell):
    table = study / "data.csv"
    lines = table.read_text().splitlines()
    lines[3] = ",".join([*lines[3].split(",")[:-1], cell])
    table.write_text("\n".join(lines) + "\n")
    assert "expected a" in told("check", study)


@pytest.mark.parametrize("value", ["1" + "0" * 400, "1e400", "-1e308", "9" * 400, "0x" + "f" * 400])
def test_giant_numbers_in_cells_and_keys(study, value):
    told("check", study, "--set", f"instrument.range_sigma_um={value}")
    table = study / "data.csv"
    lines = table.read_text().splitlines()
    lines[3] = ",".join([*lines[3].split(",")[:-1], value])
    table.write_text("\n".join(lines) + "\n")
    told("check", study)


def test_the_file_of_the_issue(tmp_path):
    folder = Path(vcal.__file__).parents[2] / "shared" / "data" / "broken" / "effects_file_runs"
    if not folder.is_dir():
        pytest.skip("needs ../shared")
    assert "--trust" in told("check", folder)
