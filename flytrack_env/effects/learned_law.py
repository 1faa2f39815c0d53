"""A law without a name, which a diagnosis has found in a log: see ``flytrack_env.effects.grammar``."""

from typing import NamedTuple

from flytrack_env.effects.grammar import Law, law_from_json, learned_effect
from flytrack_env.quaternion import Scalar


class LearnedLaw(NamedTuple):
    """A law, its share that acts, 1 as learnt, and by how many standard errors its coefficients are larger.

    law: static. Draw ``spread`` from -1 to 1, say, to fly what the log cannot tell.
    """

    scale: Scalar = 0.0
    spread: Scalar = 0.0
    law: Law = Law()


LEARNED_LAW = learned_effect(
    "law",
    law_from_json,
    name="learned_law",
    parameters=LearnedLaw,
    equation=r"\mathbf{f}_b \leftarrow \mathbf{f}_b + s \sum_k \mathbf{c}_k\, g_k h_k",
    source="the log that it was learnt from; sums of products of given functions: S. Brunton et al., "
    '"Discovering governing equations from data by sparse identification", 2016',
)
