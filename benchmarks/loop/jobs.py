"""The jobs of the loop's benchmark, each on one core: shared policies, and one job per plant.

A job is ``nominal`` or ``randomised`` (shared policies), ``shipped``, the number of a hidden plant,
or ``law_`` and that of a plant with a law outside the package's list.
"""

import json
import shutil
import time
import traceback
from contextlib import redirect_stderr, redirect_stdout
from pathlib import Path
from typing import Any

from benchmarks.report import write_json

SHARED = {"nominal": "FlyTrack-v0", "randomised": "FlyTrackRandomized-v0"}
RESULT, LOG = "result.json", "log.txt"
LAW = "law_"


def run_job(job: str, out: Path, steps: int, seed: int) -> dict[str, Any]:
    """Return a job's result, from its file if it has finished; an unfinished job starts again.

    What it prints goes to a log in the job's folder, and so does where it failed. Compiled programs
    are dropped afterwards: the system limits how many memory mappings a process may have.
    """
    folder = out / job
    if (folder / RESULT).exists():
        return dict(json.loads((folder / RESULT).read_text()))
    # Else its trainings would be refused as another run's.
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    import jax

    started_s = time.process_time()
    with (folder / LOG).open("w") as log, redirect_stdout(log), redirect_stderr(log):
        try:
            result = (train_shared if job in SHARED else measure_plant)(job, out, steps, seed)
        except Exception:
            traceback.print_exc()
            raise
    jax.clear_caches()
    result["cpu_s"] = time.process_time() - started_s
    write_json(folder / RESULT, result)
    return result


def train_shared(job: str, out: Path, steps: int, seed: int) -> dict[str, Any]:
    """Train a policy on the nominal drone, or on randomised drones around it."""
    from baselines.purejaxrl_ppo import Config
    from baselines.purejaxrl_ppo.training import train_policy
    from flytrack_loop.loop import seeds_of

    train_policy(out / job, Config(total_timesteps=steps), seeds_of(seed)["train"], SHARED[job])
    return {"job": job}


def make_plant(job: str, seed: int) -> tuple[Any, str]:
    """Return the plant of a job, and its hidden effects as text."""
    from benchmarks.loop.plants import draw_plant, draw_plant_with_law
    from flytrack_bench.hidden import HiddenPlant
    from flytrack_env import blackbox

    if job == "shipped":
        return blackbox.load(blackbox.SHIPPED), "the shipped black box"
    if job.startswith(LAW):
        truth = draw_plant_with_law(int(job.removeprefix(LAW)), seed)
    else:
        truth = draw_plant(int(job), seed)
    return HiddenPlant(truth), truth.text()


def measure_plant(job: str, out: Path, steps: int, seed: int) -> dict[str, Any]:
    """Close the loop on a plant, train on the refitted base model, and fly the shared policies."""
    from baselines.purejaxrl_ppo import Config, load_checkpoint
    from flytrack_env import nominal_parameters
    from flytrack_loop import close_loop, train_stage
    from flytrack_loop.loop import Settings, loop_as_json, seeds_of
    from flytrack_loop.stages import judge, stage_as_json

    plant, hidden = make_plant(job, seed)
    config, seeds, settings = Config(total_timesteps=steps), seeds_of(seed), Settings()
    loop = close_loop(plant, out / job, config, seed, settings)
    scoring = (seeds["evaluation"], loop.held_out)
    base, train_seed = loop.diagnosis.base, seeds["train"]
    stages = [train_stage("refitted_base", base, plant, out / job, config, train_seed, *scoring)]
    for name in SHARED:
        checkpoint = load_checkpoint(out / name / "final.safetensors")
        stages.append(judge(name, nominal_parameters(), checkpoint, plant, *scoring))
    content = loop_as_json(loop, seed, config, settings)
    content["stages"] += [stage_as_json(stage) for stage in stages]
    return {"job": job, "hidden": hidden, **content}
