"""``python -m flytrack``: the command without its script."""

from flytrack.cli import main

main()
