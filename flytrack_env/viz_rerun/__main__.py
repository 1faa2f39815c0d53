"""``python -m flytrack_env.viz_rerun``."""

import sys

from flytrack_env.viz_rerun.command import main

if __name__ == "__main__":
    sys.exit(main())
