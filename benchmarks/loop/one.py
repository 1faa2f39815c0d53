"""One plant: the loop, and the alternatives at equal training budget; a process of its own on one core.

``python -m benchmarks.loop.one JOB OUT --core C``; JOB is ``nominal``, ``randomised`` (the policies that no
plant was asked for), ``shipped`` or the number of a hidden plant. ``python -m benchmarks.loop`` starts these.
"""

import argparse
import json
import os
import time
from pathlib import Path
from typing import Any

SHARED = {"nominal": "FlyTrack-v0", "randomised": "FlyTrackRandomized-v0"}
RESULT = "result.json"


def make_plant(job: str, seed: int) -> tuple[Any, str]:
    """Return the plant of a job, and what is hidden in it, as text."""
    from benchmarks.loop.draws import draw_plant
    from benchmarks.loop.plant import HiddenPlant
    from eval_agent import SHIPPED_BLACK_BOX
    from flytrack_env import blackbox

    if job == "shipped":
        return blackbox.load(SHIPPED_BLACK_BOX), "the shipped black box"
    truth = draw_plant(int(job), seed)
    return HiddenPlant(truth), truth.text()


def train_shared(job: str, out: Path, steps: int, seed: int) -> dict[str, Any]:
    """Train a policy on the nominal drone, or on drones drawn around it."""
    from baselines.purejaxrl_ppo import Config
    from baselines.purejaxrl_ppo.train_ppo import train_policy
    from flytrack_loop.loop import seeds_of

    train_policy(out / job, Config(total_timesteps=steps), seeds_of(seed)["train"], SHARED[job])
    return {"job": job}


def measure_plant(job: str, out: Path, steps: int, seed: int) -> dict[str, Any]:
    """Close the loop on a plant, train on the refitted base, fly what no plant was asked for."""
    from baselines.purejaxrl_ppo import Config, load_checkpoint
    from flytrack_env import nominal_parameters
    from flytrack_loop import close_loop, train_stage
    from flytrack_loop.loop import Settings, loop_as_json, seeds_of
    from flytrack_loop.stages import judge, stage_as_json

    plant, hidden = make_plant(job, seed)
    config, seeds, settings = Config(total_timesteps=steps), seeds_of(seed), Settings()
    loop = close_loop(plant, out / job, config, seed, settings)
    rest = (seeds["train"], seeds["evaluation"], loop.held_out)
    stages = [train_stage("refitted_base", loop.diagnosis.base, plant, out / job, config, *rest)]
    for name in SHARED:
        checkpoint = load_checkpoint(out / name / "final.msgpack")
        model = nominal_parameters()
        stages.append(judge(name, model, checkpoint, plant, seeds["evaluation"], loop.held_out))
    content = loop_as_json(loop, seed, config, settings)
    content["stages"] += [stage_as_json(stage) for stage in stages]
    return {"job": job, "hidden": hidden, **content}


def main() -> None:
    """Do one job; write its result."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("job")
    parser.add_argument("out", type=Path)
    parser.add_argument("--core", type=int, required=True)
    parser.add_argument("--seed", type=int, required=True)
    parser.add_argument("--steps", type=int, required=True)
    arguments = parser.parse_args()
    os.environ["OMP_NUM_THREADS"] = "1"
    if hasattr(os, "sched_setaffinity"):  # before JAX is read, which looks at it once
        os.sched_setaffinity(0, {arguments.core})
    from flytrack_env.files import write_atomically

    wall, cpu = time.perf_counter(), time.process_time()
    work = train_shared if arguments.job in SHARED else measure_plant
    result = work(arguments.job, arguments.out, arguments.steps, arguments.seed)
    result |= {"wall_s": time.perf_counter() - wall, "cpu_s": time.process_time() - cpu}
    path = arguments.out / arguments.job / RESULT
    write_atomically(path, (json.dumps(result, indent=2, allow_nan=False) + "\n").encode())


if __name__ == "__main__":
    main()
