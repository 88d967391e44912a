"""``python -m vcal`` is ``vcal``."""

from .cli import main

if __name__ == "__main__":
    main()
