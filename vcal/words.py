"""Words of messages that depend on a number."""


def plural(count: int, one: str, several: str = "") -> str:
    """The noun for a number of things; `several` is its plural where that is not `one` with an s.

    ``plural(1, "row")`` gives ``"row"``, ``plural(0, "row")`` gives ``"rows"``.
    """
    return one if count == 1 else several or f"{one}s"


def counted(count: int, one: str, several: str = "") -> str:
    """A number with its noun: ``"1 reading"``, ``"3 readings"``."""
    return f"{count} {plural(count, one, several)}"
