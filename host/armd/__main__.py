"""``python -m armd``."""

from armd.cli import main

if __name__ == "__main__":
    main()
