"""The environments as Gymnasium environments, single and vectorised (docs/gymnasium.md).

Importing this package registers nothing and compiles nothing; Gymnasium imports ``environments``
when the first one is made.
"""

import gymnasium

from flytrack_env.registration import ENVIRONMENTS

__all__ = ["register_with_gymnasium"]


def register_with_gymnasium() -> None:
    """Register every id with Gymnasium; ids that are registered already are left alone.

    Without a time limit of Gymnasium's: the environments truncate by themselves.
    """
    for env_id in ENVIRONMENTS:
        if env_id not in gymnasium.registry:
            gymnasium.register(
                env_id,
                entry_point=f"{__name__}.environments:FlyTrackEnv",
                vector_entry_point=f"{__name__}.environments:FlyTrackVectorEnv",
                kwargs={"env_id": env_id},
            )
