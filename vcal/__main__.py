"""``python -m vcal`` is ``vcal``, whose entry point this is."""

from .starting import starting


def main() -> None:
    """Run the command line; the process ends with its exit code."""
    with starting():
        from .cli import main as run
    run()


if __name__ == "__main__":
    main()
