"""Fly a checkpoint: ``python eval_agent.py --checkpoint PATH --steps N``; the same as ``flytrack eval``."""

import sys

from flytrack.cli import main

if __name__ == "__main__":
    main(["eval", *sys.argv[1:]])
