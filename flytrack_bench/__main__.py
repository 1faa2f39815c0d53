"""``flytrack bench``: the command without ``flytrack``."""

from flytrack_bench.cli import main

main()
