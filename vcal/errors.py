"""The one exception a user's mistake raises."""


class StudyError(ValueError):
    """A user's input cannot be used as it stands.

    The message is complete on its own: it names the file and the row, column or key, says what was
    found and what was expected, and what to do. The command line prints it and exits with code 2.
    """
