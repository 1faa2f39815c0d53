"""What works with the core dependencies alone, and what names the extra that it wants.

Run by ``release.check_wheel``. Some packages of extras come with the core dependencies, too: gymnax brings
matplotlib. What then works without its extra is told.
"""

import importlib
import pkgutil
import subprocess
import sys
from collections.abc import Callable
from importlib import metadata
from pathlib import Path

import gymnasium
import gymnax
import jax
import numpy as np

import flytrack_env
from flytrack_env import pictures

PACKAGES = ("flytrack_env", "flytrack_sysid", "flytrack_loop", "baselines")
# Their modules are imported by functions of their package, which ask for the extra themselves (``ASKED``).
ON_DEMAND = ("flytrack_env.pictures.", "flytrack_env.rendering.")
SITE = Path(flytrack_env.__file__).parents[1]
STATES, ACTIONS = np.zeros((3, 21), np.float32), np.zeros((3, 4), np.float32)
STATES[:, 9] = 1.0


def flight() -> pictures.Flight:
    """Return a flight that can be drawn."""
    return pictures.make_flight("standing", STATES, ACTIONS, flytrack_env.load_track("flytrack"))


ASKED: dict[str, tuple[str, Callable[[], object]]] = {
    "identification": ("sysid", lambda: importlib.import_module("flytrack_sysid")),
    "its command": ("sysid", lambda: importlib.import_module("flytrack_sysid.cli")),
    "training": ("train", lambda: importlib.import_module("baselines.purejaxrl_ppo.train_ppo")),
    "recordings": ("viz", lambda: importlib.import_module("flytrack_env.viz_rerun")),
    "their command": ("viz", lambda: importlib.import_module("flytrack_env.viz_rerun.__main__")),
    "drawing": ("viz", lambda: pictures.draw_flight(flight())),
    "a video": ("render", lambda: pictures.write_video(flight(), ".")),
    "rendering": ("render", lambda: gymnasium.make("FlyTrack-v0", render_mode="rgb_array")),
    "a window": ("render", lambda: gymnasium.make("FlyTrack-v0", render_mode="human")),
    "many pictures": (
        "render",
        lambda: gymnasium.make_vec(
            "FlyTrack-v0",
            num_envs=2,
            vectorization_mode="vector_entry_point",
            render_mode="rgb_array",
        ),
    ),
}


def install(extra: str) -> str:
    """Return the command that a message must name."""
    return f"pip install 'flytrack[{extra}]'"


def fly_everything() -> None:
    """Reset and step every id, in gymnax, in Gymnasium, and several at once."""
    for env_id in flytrack_env.registration.ENVIRONMENTS:
        env, params = gymnax.make(env_id)
        observation, state = env.reset(jax.random.key(0), params)
        action = env.action_space(params).sample(jax.random.key(1))
        outputs = env.step(jax.random.key(2), state, action, params)
        assert outputs[0].shape == observation.shape and np.isfinite(outputs[2])
        single = gymnasium.make(f"flytrack_env:{env_id}")
        seen, _ = single.reset(seed=0)
        assert single.observation_space.contains(seen)
        assert single.observation_space.contains(single.step(single.action_space.sample())[0])
        several = gymnasium.make_vec(env_id, num_envs=3, vectorization_mode="vector_entry_point")
        assert several.reset(seed=0)[0].shape == several.step(several.action_space.sample())[0].shape
    print(f"{len(flytrack_env.registration.ENVIRONMENTS)} ids fly")


def check_messages() -> None:
    """Use what needs an extra: it names the extra, or works as other packages brought what it needs."""
    refused = set()
    for what, (extra, use) in ASKED.items():
        try:
            use()
        except ImportError as error:
            assert install(extra) in str(error), f"{what}: says {error}"
            refused.add(extra)
        else:
            print(f"{what}: works without [{extra}]")
    assert refused == {extra for extra, _ in ASKED.values()}, f"found refusals of {refused} alone"
    command = Path(sys.executable).with_name("flytrack-sysid")
    said = subprocess.run([command, "--help"], capture_output=True, text=True)
    assert said.returncode != 0 and install("sysid") in said.stderr.splitlines()[-1], said.stderr
    print("what does not work names its extra")


def check_modules() -> None:
    """Import every module: each can be imported, or names an extra."""
    count = 0
    for package in PACKAGES:
        names = [package] + [f"{package}.{name}" for name in walk(package)]
        for name in names:
            if name.endswith("__main__"):
                continue
            count += 1
            try:
                importlib.import_module(name)
            except ImportError as error:
                is_told = "pip install 'flytrack[" in str(error)
                assert is_told or name.startswith(ON_DEMAND), f"{name}: {error}"
    print(f"{count} modules can be imported, or name an extra")


def walk(package: str) -> list[str]:
    """Return the names of a package's modules, below it, without importing it."""
    folder = SITE.joinpath(*package.split("."))
    found = []
    for info in pkgutil.iter_modules([str(folder)]):
        found.append(info.name)
        if info.ispkg:
            found += [f"{info.name}.{name}" for name in walk(f"{package}.{info.name}")]
    return found


def main() -> None:
    """Check them all."""
    assert SITE.name == "site-packages", f"{SITE}: found a checkout, expected what is installed"
    assert metadata.version("flytrack") == flytrack_env.__version__
    assert all((SITE / package / "py.typed").is_file() for package in PACKAGES)
    fly_everything()
    check_messages()
    check_modules()


if __name__ == "__main__":
    main()
