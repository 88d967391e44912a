"""Which Python files of a study may be run, and which files outside its folder may be read.

A study may come from somebody else. A Python file that it names is run only where the user has
agreed: for this call (``--trust``), for a folder in the user's own settings, or before for the same
file with the same contents. Nothing in the folder of a study can give this consent.
"""

import contextlib
import hashlib
import os
import tempfile
import tomllib
from pathlib import Path

from ..user_files import config_base, is_own, state_base
from .messages import refusal, shown

_KEY = "trusted"
_SETTINGS = "config.toml"
_AGAIN = "repeat the command with --trust (in Python: load_study(..., trust=True))"


def settings_file() -> Path | None:
    """The settings file of the user, ``config.toml`` in the folder of settings."""
    base = config_base()
    return None if base is None else base / _SETTINGS


def is_inside(path: Path, folder: Path) -> bool:
    """Whether a path lies in a folder, after all links of both are followed."""
    return Path(os.path.realpath(path)).is_relative_to(os.path.realpath(folder))


def trusted_folders() -> list[Path]:
    """The folders in `trusted` of the user's settings; none without settings.

    Raises `StudyError` for a file that is not TOML, that belongs to somebody else or that others
    may write, and for an entry that is no absolute path.
    """
    file = settings_file()
    if file is None or not file.is_file():
        return []
    if not is_own(file):
        raise refusal(
            str(file),
            "file",
            "settings that belong to another user, or that others may write",
            "a file of your own, as it decides which code is run",
            "correct its owner and permissions, or remove it",
        )
    try:
        content = tomllib.loads(file.read_text(encoding="utf-8-sig"))
    except (ValueError, RecursionError) as error:
        raise refusal(
            str(file), "file", "what is not TOML", f'{_KEY} = ["FOLDER"]', "correct it"
        ) from error
    if unknown := sorted(content.keys() - {_KEY}):
        raise refusal(str(file), f"key {unknown[0]}", "it", f"the key {_KEY} only", "remove it")
    return _folders(content.get(_KEY, []), file)


def _folders(names: object, file: Path) -> list[Path]:
    """The named folders; raises `StudyError` for what is no list of absolute paths."""
    given = names if isinstance(names, list) else [None]
    found = [Path(one).expanduser() if isinstance(one, str) else Path() for one in given]
    if not all(one.is_absolute() for one in found):
        raise refusal(
            str(file),
            f"key {_KEY}",
            shown(names),
            'a list of absolute paths, such as ["/home/me/studies"]',
            "correct it",
        )
    return found


def require_inside(
    root: Path, name: str, *, code: bool = False, allowed: bool = False, key: str = "file"
) -> None:
    """Raise `StudyError` for a file that a study names outside its folder `root`.

    Outside are absolute paths, paths with ``..`` and links that lead out. Data are read from there
    with `allowed`, code (`code`) only from the trusted folders of the user's settings.
    """
    path, parts = root / name, Path(name)
    direct = not parts.anchor and ".." not in parts.parts
    if "\0" in name or (direct and is_inside(path, root)):
        return  # no file has a zero character in its name
    if code:
        if _in_trusted(path):
            return
        raise refusal(
            name,
            key,
            f"Python code outside the folder of the study, at {os.path.realpath(path)}",
            f"a file in {root}",
            f"copy it there, or list its folder as {_KEY} in {settings_file()}",
        )
    if allowed:
        return
    what = "a path that leads" if not direct else "a link that leads"
    raise refusal(
        name,
        key,
        f"{what} outside the folder of the study, to {os.path.realpath(path)}",
        f"a file in {root}",
        "copy it there, or repeat the command with --allow-outside "
        "(in Python: load_study(..., allow_outside=True))",
    )


def require_consent(root: Path, name: str, source: bytes, what: str, trust: bool) -> None:
    """Raise `StudyError` for a Python file that the user has not agreed to run.

    `source` are the contents that will be run, `what` the kind of its classes. With `trust`, the
    consent is remembered for this path and these contents.
    """
    path = Path(os.path.realpath(root / name))
    if trust:
        _remember(path, source)
        return
    if _remembered(path, source) or _in_trusted(path):
        return
    raise refusal(
        name,
        "file",
        f"Python code with {what} classes, which the study names",
        "permission to run it, as it can do anything that you can",
        f"read it, then {_AGAIN}",
    )


def _in_trusted(path: Path) -> bool:
    return any(is_inside(path, folder) for folder in trusted_folders())


def _note_of(path: Path) -> Path | None:
    """The file that holds the SHA-256 of the contents that were trusted at a path."""
    base = state_base()
    name = hashlib.sha256(os.fsencode(path)).hexdigest()
    return None if base is None else base / _KEY / name


def _remembered(path: Path, source: bytes) -> bool:
    note = _note_of(path)
    try:
        if note is None or not is_own(note):
            return False
        return note.read_text(encoding="utf-8").split("\n", 1)[0] == _sum(source)
    except (OSError, UnicodeDecodeError):
        return False


def _remember(path: Path, source: bytes) -> None:
    """Keep the SHA-256 of trusted contents; where that fails, the user is asked again."""
    note = _note_of(path)
    if note is None or _remembered(path, source):
        return
    with contextlib.suppress(OSError):
        note.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
        number, new = tempfile.mkstemp(dir=note.parent)
        try:
            with open(number, "wb") as file:
                file.write(f"{_sum(source)}\n".encode() + os.fsencode(path) + b"\n")
            os.replace(new, note)
        except OSError:
            os.unlink(new)
            raise


def _sum(source: bytes) -> str:
    return hashlib.sha256(source).hexdigest()
