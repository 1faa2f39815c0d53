"""Fly a checkpoint, as ``flytrack eval`` does.

Usage: ``python eval_agent.py --checkpoint PATH --steps N``.
"""

import sys

from flytrack.cli import main

if __name__ == "__main__":
    main(["eval", *sys.argv[1:]])
