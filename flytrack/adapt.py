"""What ``flytrack adapt`` does."""

from baselines.purejaxrl_ppo import load_checkpoint
from baselines.purejaxrl_ppo.checkpoint import SUFFIX, save_checkpoint
from flytrack.flags import Adapt
from flytrack_env.files import write_atomically
from flytrack_env.model_file import load_model
from flytrack_env.progress import ProgressBar
from flytrack_loop.adapt import adapt, describe_adapted
from flytrack_sysid.log_file import describe, load_log


def run_adapt(flags: Adapt) -> None:
    """Adapt the policy, print what was wrong and what is expected, and write the policy.

    Raises:
        OSError, ValueError: what cannot be used, before any work.
    """
    if flags.out.suffix != SUFFIX:
        raise ValueError(f"--out {flags.out}: found suffix {flags.out.suffix!r}, expected {SUFFIX}")
    checkpoint = load_checkpoint(flags.checkpoint)
    if flags.out.resolve() in (checkpoint.path.resolve(), flags.log.resolve()):
        raise ValueError(f"--out {flags.out}: found a file that is read, expected another")
    craft = None if flags.model is None else load_model(flags.model)
    log = load_log(flags.log)
    print(f"{describe(log)}\npolicy: {checkpoint.path.name}", flush=True)  # what follows takes long
    adapted = adapt(
        log, checkpoint, flags.seed, accept=flags.accept, report=ProgressBar, craft=craft
    )
    if adapted.is_new:
        new = adapted.checkpoint
        save_checkpoint(flags.out, new.params, new.config, new.meta)
    else:
        write_atomically(flags.out, checkpoint.path.read_bytes())
    print(f"{describe_adapted(adapted)}\nwritten: {flags.out}")
