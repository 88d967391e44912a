"""Work for other processes, which they import by its name."""

import os
import signal
from pathlib import Path


def square(job: tuple[int, Path]) -> int:
    """The square of a number. A number above 10 ends the process where it is begun for the first
    time, one above 20 always.
    """
    number, folder = job
    begun = folder / f"{number}"
    first = not begun.exists()
    with begun.open("a") as file:
        file.write("x")
    if number > 20 or (number > 10 and first):
        os.kill(os.getpid(), signal.SIGKILL)
    return number**2
