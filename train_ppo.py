"""Train PPO: ``python train_ppo.py --out FOLDER``; the same as ``flytrack train``."""

import sys

from flytrack.cli import main

if __name__ == "__main__":
    main(["train", *sys.argv[1:]])
