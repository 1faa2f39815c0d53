"""What ``flytrack loop`` does, and its flags."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

from tyro.conf import arg

from baselines.purejaxrl_ppo import Config
from flytrack.flags import NO_HINT, OptionalPath
from flytrack_env import ModelParameters, blackbox
from flytrack_env.files import fresh_folder
from flytrack_env.plants import Plant
from flytrack_loop.loop import Settings, close_loop
from flytrack_loop.report import describe, write_flights


@dataclass(frozen=True)
class Loop:
    """Flags of ``flytrack loop``."""

    black_box: OptionalPath = None
    """The plant, an acro_step.bin; default: the shipped one."""
    plant: Annotated[
        Literal["betaflight"] | None, arg(metavar="betaflight", help_behavior_hint=NO_HINT)
    ] = None
    """Instead of a black box: Betaflight's firmware on a simulated body, of a clone."""
    dump: OptionalPath = None
    """The firmware's settings: the text of a pilot's dump or diff all."""
    skip: tuple[str, ...] = ()
    """Patterns of settings in the dump that are left out."""
    body: OptionalPath = None
    """The firmware's body: a JSON object of fields of firmware.Body."""
    out: OptionalPath = None
    """Folder to write to; default: runs/loop_NAME, or the next free name."""
    seed: int = 0
    """Seed of flights and trainings."""
    total_timesteps: float = Config.total_timesteps
    """Environment steps of each training."""
    settings: Settings = field(default_factory=Settings)
    """Of the flights."""


@contextmanager
def _opened(flags: Loop) -> Iterator[tuple[Plant, ModelParameters | None]]:
    """Yield the plant and, if it has one of its own, the model to fit from.

    Nothing is left running afterwards.
    """
    if flags.plant is None:
        if flags.dump or flags.body or flags.skip:
            raise ValueError("--dump, --skip and --body: expected with --plant betaflight only")
        yield blackbox.load(flags.black_box or blackbox.SHIPPED), None
        return
    if flags.black_box is not None:
        raise ValueError("--plant: found --black-box as well, expected one of the two")
    try:
        from firmware import Betaflight, Body, read_body
    except ModuleNotFoundError as error:
        raise ValueError(
            "--plant betaflight: found no folder firmware/, expected a clone"
        ) from error
    dump = None if flags.dump is None else flags.dump.read_text(encoding="utf-8")
    body = Body() if flags.body is None else read_body(flags.body)
    with Betaflight({} if dump is None else dump, body, flags.skip) as plant:
        yield plant, plant.nominal_model()


def run_loop(flags: Loop) -> None:
    """Close the loop and print before and after.

    Raises:
        OSError, ValueError: what cannot be used.
    """
    name = flags.plant or (flags.black_box or blackbox.SHIPPED).stem
    config = Config(total_timesteps=int(flags.total_timesteps))
    with _opened(flags) as (plant, start):
        out = flags.out or fresh_folder(Path("runs") / f"loop_{name}")
        loop = close_loop(plant, out, config, flags.seed, flags.settings, start=start)
        files = write_flights(out, loop, plant, flags.seed)
    print(describe(loop))
    names = ", ".join(one.name for one in files)
    print(f"written: {out}/ with loop.json, diagnosis/report.html, {names}")
