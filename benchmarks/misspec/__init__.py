"""Rivals on ``misspec-v1``, each as its author would write it, through the benchmark's door.

``flytrack bench --suite misspec-v1 --method benchmarks.misspec.rivals:NAME --out result.json``;
``rivals`` says what each is. ``python -m benchmarks.misspec.page`` writes docs/results/misspec.md.
"""
