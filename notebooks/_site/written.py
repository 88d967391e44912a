"""A folder of pages that are written when the documentation is built."""

from collections.abc import Mapping
from pathlib import Path


class Written:
    """Files that belong to the build: git ignores the folder, and nothing else is in it."""

    def __init__(self, folder: Path):
        self.folder = folder

    def update(self, files: Mapping[str, str | bytes]) -> None:
        """Make the folder hold these files and no others; what has not changed keeps its time, so
        that it is not read again.
        """
        self.folder.mkdir(parents=True, exist_ok=True)
        for name, content in files.items():
            path = self.folder / name
            data = content.encode() if isinstance(content, str) else content
            if not path.is_file() or path.read_bytes() != data:
                path.write_bytes(data)
        for path in self.folder.iterdir():
            if path.name not in files:
                path.unlink()
