"""``python -m vcal`` is ``vcal``, whose entry point this is."""

import gc

from .startup import importing


def main() -> None:
    """Run the command line; the process ends with its exit code."""
    with importing():
        from .cli import main as run
    gc.freeze()  # what has been imported stays; collections need not look at it again
    run()


if __name__ == "__main__":
    main()
