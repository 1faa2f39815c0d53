"""The main job on the shipped black box: ``flytrack demo``, from a clone (``make demo``)."""

import sys

from flytrack.cli import main

if __name__ == "__main__":
    main(["demo", *sys.argv[1:]])
