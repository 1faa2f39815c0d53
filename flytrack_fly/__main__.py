"""``python -m flytrack_fly``."""

from flytrack_fly.cli import main

if __name__ == "__main__":
    main()
