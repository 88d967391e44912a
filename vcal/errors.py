"""The exception for mistakes in a user's input, and its variants for rows and keys."""


class StudyError(ValueError):
    """A user's input cannot be used.

    The message is self-contained: it names the file and the row, column or key, states what was
    found and what was expected, and what to do. The command line prints it and exits with code 2.
    """


class RowError(StudyError):
    """A row of a data set that its instrument cannot use.

    The instrument knows the row, and the reader of the table knows file and line. The message for
    the user is composed from both (`vcal.study.messages`).
    """

    def __init__(self, row: int, place: str, found: str, expected: str, do: str):
        self.row, self.place = row, place
        self.what = f"found {found}, expected {expected}; {do}"
        where = f"data, row {row + 1}" + (f", {place}" if place else "")
        super().__init__(f"{where}: {self.what}")


class KeyedError(StudyError):
    """A key of the study file that is inconsistent with other keys, or with the machine.

    The instrument knows the key, and the reader of the study file knows the name of the file.
    """

    def __init__(self, key: str, found: str, expected: str, do: str):
        self.key = key
        self.what = f"found {found}, expected {expected}; {do}"
        super().__init__(f"key {key}: {self.what}")
