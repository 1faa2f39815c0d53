"""Checks of releases: ``make check-wheel check-versions``.

``nox --list`` names the sessions. They install into fresh environments, made by uv, and run in
empty folders, so that nothing of the checkout can be imported by accident.
"""

import shlex
import shutil
import subprocess
import sys
import tarfile
import zipfile
from functools import cache
from pathlib import Path

import nox

nox.options.default_venv_backend = "uv"
nox.options.sessions = []  # a bare call names the sessions and runs none
nox.options.error_on_missing_interpreters = False

ROOT = Path(__file__).parent
PACKAGES = (
    "baselines/",
    *(f"flytrack{name}/" for name in ("", "_bench", "_env", "_fly", "_loop", "_sysid")),
)
CLONE_ONLY = "firmware/"
OF_GITHUB = ".github/"
HEADLESS = {
    "JAX_PLATFORMS": "cpu",
    "MPLBACKEND": "agg",
    "SDL_VIDEODRIVER": "dummy",
    "PYTHONPATH": "",
}
TEST_TOOLS = ("pytest>=9", "hypothesis>=6.150", "pillow", "pyulog>=1.2", "orangebox>=0.4,<0.5")

FLY_EVERY_ID = """
import gymnasium, gymnax, jax, flytrack_env
from flytrack_env.registration import ENVIRONMENTS, RACES
for env_id in (*ENVIRONMENTS, *RACES):
    env, params = gymnax.make(env_id)
    key = jax.random.key(0)
    env.step(key, env.reset(key, params)[1], env.action_space(params).sample(key), params)
for env_id in ENVIRONMENTS:
    envs = gymnasium.make_vec(
        f"flytrack_env:{env_id}", num_envs=3, vectorization_mode="vector_entry_point"
    )
    assert envs.reset(seed=0)[0].shape == envs.step(envs.action_space.sample())[0].shape
"""
MISSING_EXTRA_IS_NAMED = """
import importlib
from pytest import raises
for extra, module in (("sysid", "flytrack_sysid"), ("train", "baselines.purejaxrl_ppo")):
    with raises(ImportError, match=rf"pip install 'flytrack\\[{extra}\\]'"):
        importlib.import_module(module)
"""
LOAD_CHAMPION = """
from baselines.purejaxrl_ppo import load_checkpoint
for name in ("champion", "robust", "corners"):
    load_checkpoint(name)
"""
SAVE_GHOST = """
import numpy as np
from flytrack_env import load_track
from flytrack_env.references import ghost_rollout, shipped_references
from flytrack_env.rollout import save_rollout
ghost = shipped_references(load_track("flytrack"), ("nominal",))
save_rollout("flight.npy", *map(np.asarray, ghost_rollout(ghost, 400)))
"""
RENDER = """
import gymnasium
from gymnasium.wrappers import RecordVideo
film, window = (
    gymnasium.make("flytrack_env:FlyTrack-v0", render_mode=mode) for mode in ("rgb_array", "human")
)
for env in (RecordVideo(film, "videos", lambda number: True, video_length=30), window):
    env.reset(seed=0)
    env.step(env.action_space.sample())
    env.close()
"""
RENDER_RECIPE = """
import sys
from rattler_build import Stage0Recipe, VariantConfig
(rendered,) = Stage0Recipe.from_file(sys.argv[1]).render(VariantConfig())
assert rendered.recipe.to_dict()["build"]["noarch"] == "python"
print("rendered", rendered.recipe.package.name, rendered.recipe.package.version)
"""
FLY_BY_HAND = """
import pygame
from flytrack.cli import main
pygame.display.init()
pygame.event.post(pygame.event.Event(pygame.QUIT))
main(["fly"])
"""
RACE_IN_OTHER_LIBRARIES = """
import jax, flytrack_env
from flytrack_env.multi_drone.jaxmarl_api import JaxMarlRace
from flytrack_env.multi_drone.pettingzoo_api import ParallelRace
race = flytrack_env.make_race("FlyTrackDuel-v0")
for reset in (ParallelRace(race).reset, lambda: JaxMarlRace(race).reset(jax.random.key(0))):
    assert set(reset()[0]) == {"drone_0", "drone_1"}
"""
SIZES = "--num-envs 16 --num-steps 32 --num-minibatches 4 --total-timesteps 1024 --hidden-sizes 8"

# What each extra is for: commands, or code. [speed] compiles for ten minutes, in 4 GB.
USES = {
    "": (
        FLY_EVERY_ID,
        MISSING_EXTRA_IS_NAMED,
        "flytrack --help",
        "flytrack demo --help",
        "flytrack train --help",
    ),
    "train": (
        f"flytrack train {SIZES} --out small",
        "flytrack demo --quick",
        "flytrack eval --checkpoint champion --steps 300",
        LOAD_CHAMPION,
    ),
    "sysid": (
        "flytrack collect --minutes 1 --out data.npz",
        "flytrack fit data.npz --out model.json",
        "flytrack validate model.json data.npz --out report",
        "flytrack diagnose data.npz --model model.json --out diagnosis",
    ),
    "logs": (
        "python -m pytest -q tests/unit/test_import_ulog.py tests/unit/test_import_betaflight.py",
    ),
    "bags": ("python -m pytest -q tests/unit/test_import_bag.py",),
    "viz": (SAVE_GHOST, "flytrack show flight.npy"),
    "render": (RENDER,),
    "multi": (RACE_IN_OTHER_LIBRARIES,),
    "fly": (FLY_BY_HAND,),
    "export": ("flytrack export champion --onnx policy.onnx --c policy.h",),
    "cluster": (
        "flytrack collect --minutes 1 --out season/red/flight1.npz",
        "flytrack diagnose season --fleet --address local --out fleet",
    ),
    "optimal": ("python -m benchmarks.time_optimal --tracks speedway --kinds flying --out made",),
    "speed": ("from benchmarks.env_speed import l2f_contestant as l2f; l2f('l2f', 1024, 8).run()",),
}
WITH_CHECKOUT = ("logs", "bags", "optimal", "speed")  # use files that the wheel does not have:
COPIED = ("benchmarks", "blackbox", "tests", "pyproject.toml")


@cache
def built() -> tuple[Path, Path]:
    """Build the source distribution and, from it, the wheel; return both: wheel, source."""
    folder = ROOT / ".nox" / "dist"
    subprocess.run(
        [sys.executable, "-m", "uv", "build", "--clear", "--out-dir", folder, ROOT], check=True
    )
    return next(folder.glob("*.whl")), next(folder.glob("*.tar.gz"))


@nox.session(tags=["wheel"])
def contents(session: nox.Session) -> None:
    """Check the files of the packages.

    The wheel has the packages' files; the source distribution has every tracked file but firmware/.
    """
    listed = subprocess.run(
        ["git", "ls-files"], cwd=ROOT, capture_output=True, text=True, check=True
    )
    tracked = set(listed.stdout.splitlines())
    wheel, source = built()
    with zipfile.ZipFile(wheel) as archive:
        in_wheel = {name for name in archive.namelist() if ".dist-info/" not in name}
    with tarfile.open(source) as archive:
        in_source = {entry.name.partition("/")[2] for entry in archive if entry.isfile()}
    if difference := in_wheel ^ {path for path in tracked if path.startswith(PACKAGES)}:
        session.error(f"{wheel.name}: differs from the repository in {sorted(difference)}")
    # The folder with GPL-3 is for clones: it is in no release.
    if released := {name for name in in_wheel | in_source if name.startswith(CLONE_ONLY)}:
        session.error(f"found {sorted(released)}, expected nothing of {CLONE_ONLY} in a release")
    tracked = {path for path in tracked if not path.startswith((CLONE_ONLY, OF_GITHUB))}
    if missing := tracked - in_source - {".gitignore", ".ci/run"}:
        session.error(f"{source.name}: lacks {sorted(missing)}")


@nox.session(tags=["wheel"])
@nox.parametrize("extra", list(USES), ids=[extra or "core" for extra in USES])
def wheel(session: nox.Session, extra: str) -> None:
    """Install the wheel with one extra alone, or none, and use what the extra is for."""
    tools = TEST_TOOLS if extra in ("logs", "bags") else ("pytest",)
    session.install(f"flytrack{f'[{extra}]' if extra else ''} @ {built()[0].as_uri()}", *tools)
    folder = Path(session.create_tmp())
    for name in COPIED if extra in WITH_CHECKOUT else ():
        copy = shutil.copytree if (ROOT / name).is_dir() else shutil.copy2
        copy(ROOT / name, folder / name)
    with session.chdir(folder):
        for use in USES[extra]:
            is_command = use.startswith(("flytrack ", "python "))
            session.run(*(shlex.split(use) if is_command else ("python", "-c", use)), env=HEADLESS)


@nox.session(tags=["wheel"])
def recipe(session: nox.Session) -> None:
    """Read and render the conda recipe as rattler-build does, without its channels."""
    session.install("py-rattler-build")
    session.run("python", "-c", RENDER_RECIPE, str(ROOT / "conda" / "recipe.yaml"))


@nox.session(tags=["versions"], python=["3.11", "3.12", "3.13"])
@nox.parametrize("resolution", ["highest", "lowest-direct"])
def versions(session: nox.Session, resolution: str) -> None:
    """Run the unit tests with the newest versions, and on the oldest Python with the oldest."""
    if resolution == "lowest-direct" and session.python != "3.11":
        session.skip("the oldest versions are tried on the oldest Python alone")
    session.install(".[train,sysid,viz,cluster]", *TEST_TOOLS, "--resolution", resolution)
    lenient = ("-W", "default::DeprecationWarning") if resolution == "lowest-direct" else ()
    session.run(
        "python", "-m", "pytest", "-q", "-m", "not slow", *lenient, "tests/unit", env=HEADLESS
    )
