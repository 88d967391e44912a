"""The one exception a user's mistake raises."""


class StudyError(ValueError):
    """A user's input cannot be used as it stands.

    The message is complete on its own: it names the file and the row, column or key, says what was
    found and what was expected, and what to do. The command line prints it and exits with code 2.
    """


class RowError(StudyError):
    """A row of a data set that its instrument cannot use.

    The instrument knows the row, and who read the table its file and line: what a user sees is made
    by both (`vcal.io.study`).
    """

    def __init__(self, row: int, place: str, found: str, expected: str, do: str):
        self.row, self.place = row, place
        self.what = f"found {found}, expected {expected}; {do}"
        where = f"data, row {row + 1}" + (f", {place}" if place else "")
        super().__init__(f"{where}: {self.what}")


class KeyedError(StudyError):
    """A key of the study file that does not go with the others, or with the machine; the instrument
    knows the key, and who read the study file its name.
    """

    def __init__(self, key: str, found: str, expected: str, do: str):
        self.key = key
        self.what = f"found {found}, expected {expected}; {do}"
        super().__init__(f"key {key}: {self.what}")
