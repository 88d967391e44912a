"""``python -m vcal`` is ``vcal``, whose entry point this is."""

from .startup import importing


def main() -> None:
    """Run the command line; the process ends with its exit code."""
    with importing():
        from .cli import main as run
    run()


if __name__ == "__main__":
    main()
