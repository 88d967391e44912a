"""Known vulnerabilities of the locked packages, without network: `python .ci/audit.py [FOLDER]`.

FOLDER, or the environment variable VCAL_ADVISORIES, is a copy of advisories in the OSV format, one
JSON file each, such as the PyPI export of osv.dev. Without one, nothing is checked, and that is
said. Exit code 1 where a locked version is affected.
"""

import json
import os
import re
import sys
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from packaging.utils import canonicalize_name
from packaging.version import InvalidVersion, Version

LOCK = Path(__file__).resolve().parent.parent / "requirements-dev.txt"
_PIN = re.compile(r"^([A-Za-z0-9._-]+)==([^\s;\\]+)", re.MULTILINE)


def locked(text: str) -> dict[str, set[str]]:
    """Versions by the name of the package; several where platforms differ."""
    found: dict[str, set[str]] = {}
    for name, version in _PIN.findall(text):
        found.setdefault(canonicalize_name(name), set()).add(version)
    return found


def affected(advisory: Mapping[str, Any], pins: Mapping[str, set[str]]) -> Iterator[str]:
    """``"NAME VERSION: ID, summary"`` for every locked version that an advisory names."""
    if advisory.get("withdrawn"):
        return
    for one in advisory.get("affected", ()):
        package = one.get("package", {})
        name = canonicalize_name(package.get("name", ""))
        if package.get("ecosystem") != "PyPI" or name not in pins:
            continue
        for version in sorted(pins[name]):
            if version in one.get("versions", ()) or any(
                _in_range(Version(version), r.get("events", ()))
                for r in one.get("ranges", ())
                if r.get("type") == "ECOSYSTEM"
            ):
                yield f"{name} {version}: {advisory['id']}, {advisory.get('summary', '')}".strip()


def _in_range(version: Version, events: Any) -> bool:
    """Whether a version lies in a range of events, which are in the order of versions."""
    inside = False
    for event in events:
        kind, text = next(iter(event.items()))
        try:
            at = Version(text)
        except InvalidVersion:
            continue
        if kind == "introduced" and version >= at:
            inside = True
        elif (kind == "fixed" and version >= at) or (kind == "last_affected" and version > at):
            inside = False
    return inside


def main(arguments: list[str]) -> int:
    """Print what is affected; returns the exit code."""
    folder = arguments[0] if arguments else os.environ.get("VCAL_ADVISORIES")
    if not folder:
        print("not audited: no folder of advisories is given (VCAL_ADVISORIES)")
        return 0
    files = sorted(Path(folder).rglob("*.json"))
    if not files:
        print(f"not audited: no advisory (*.json) in {folder}")
        return 1
    pins = locked(LOCK.read_text(encoding="utf-8"))
    found = [
        line
        for file in files
        for line in affected(json.loads(file.read_text(encoding="utf-8")), pins)
    ]
    print("\n".join(found) or f"{len(pins)} packages, {len(files)} advisories: none is affected")
    return 1 if found else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
