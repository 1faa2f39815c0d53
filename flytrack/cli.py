"""``flytrack COMMAND``: one command for all that FlyTrack does.

Nothing of a command is imported before it is called, so that ``flytrack --help`` is quick and needs
no extra. ``flytrack COMMAND --help`` needs none either: it names the extra.
"""

import argparse
import contextlib
import dataclasses
import importlib
import io
import sys
import threading
import warnings
from collections.abc import Callable, Iterator, Sequence
from importlib.metadata import version
from importlib.util import find_spec
from pathlib import Path
from typing import Annotated, Any, NamedTuple, NoReturn, Union

PROG = "flytrack"
SHELLS = ("bash", "zsh", "fish")
LOADING_NOTE_S = 2.0
REFUSED, STOPPED = (
    2,
    130,
)  # exit statuses; 130 is what shells return for a command that Ctrl-C ended
CLONE = Path(__file__).parents[1]
PPO = "baselines.purejaxrl_ppo"


class Command(NamedTuple):
    """A command; ``run`` and ``flags`` are written ``module:name``.

    Attributes:
        summary: one line.
        extra: that it needs.
        run: called with the flags, or with words if it ``reads_words``: those after the command's
            name.
        flags: their dataclass; None where ``run`` has none.
    """

    summary: str
    extra: str | None
    run: str
    flags: str | None
    reads_words: bool = False


def _own(name: str, extra: str, module: str, flags: str, summary: str) -> Command:
    """Return a command of this package; module, flags: where what runs it and its flags are."""
    return Command(
        summary, extra, f"flytrack.{module}:run_{name}", f"flytrack.{flags}:{name.capitalize()}"
    )


IDENTIFICATION = ("sysid", "identification", "flags")
COMMANDS = {
    "demo": _own(
        "demo",
        "train",
        "demo",
        "flags",
        "Identify the shipped black box, train, fly, adapt",
    ),
    "train": Command(
        "Train a policy with PPO",
        "train",
        f"{PPO}.train_ppo:main",
        f"{PPO}.train_ppo:Settings",
        reads_words=True,
    ),
    "eval": Command(
        "Fly a checkpoint on a black box or on drawn plants",
        "train",
        f"{PPO}.evaluate:run_evaluation",
        f"{PPO}.evaluate:EvaluationSettings",
    ),
    "show": _own("show", "viz", "show", "flags", "Write rollouts as a recording and pictures"),
    "fly": _own("fly", "fly", "fly", "fly", "Fly by keyboard or gamepad against a ghost"),
    "collect": _own("collect", *IDENTIFICATION, "Fly an excitation or a script on a plant"),
    "fit": _own("fit", *IDENTIFICATION, "Identify a model from a flight log"),
    "validate": _own(
        "validate", *IDENTIFICATION, "Judge a model on flight that it was not fitted to"
    ),
    "diagnose": _own("diagnose", *IDENTIFICATION, "Name what a model gets wrong, and extend it"),
    "adapt": _own("adapt", "train", "adapt", "flags", "Make a better policy from a log of flight"),
    "plan": _own("plan", *IDENTIFICATION, "Plan flights that settle what a log left open"),
    "check": _own("check", *IDENTIFICATION, "Find units, signs, frames and clocks that contradict"),
    "import": _own("import", *IDENTIFICATION, "Convert logs of real flights into a flight log"),
    "loop": _own(
        "loop", "train", "loop", "loop", "Train, fly, diagnose, extend the model, train again"
    ),
    "firmware": Command(
        "Build and check Betaflight in the loop, in a clone",
        None,
        "firmware.cli:main",
        None,
        True,
    ),
    "export": Command(
        "Write a policy as ONNX or C",
        "export",
        f"{PPO}.export:run_export",
        f"{PPO}.export:ExportSettings",
    ),
    "sweep": Command(
        "Train with many settings by Ray Tune",
        "cluster",
        f"{PPO}.sweep:run_sweep",
        f"{PPO}.sweep:Flags",
    ),
    "bench": Command(
        "Fly a policy through a frozen suite of tasks",
        "bench",
        "flytrack_bench.cli:run_bench",
        "flytrack_bench.cli:Flags",
    ),
}


class NotInstalledError(Exception):
    """A command that is not installed.

    The message says what is missing and, if possible, how to install it.
    """


def load(name: str, target: str) -> Any:
    """Return what a command's ``module:name`` names.

    Raises:
        NotInstalledError: the module, or a package of the command's extra, is not installed.
    """
    module, _, attribute = target.partition(":")
    try:
        return getattr(importlib.import_module(module), attribute)
    except ImportError as error:
        missing, extra = error.name or "", COMMANDS[name].extra
        if module == missing or module.startswith(f"{missing}."):
            where = (
                "in clones of the repository only"
                if missing == "firmware"
                else "not in this version"
            )
            raise NotInstalledError(f"this command is {where}") from error
        if extra is None or not missing or find_spec(missing.partition(".")[0]) is not None:
            raise  # an error of the module, and not of the installation
        text = (
            f"needs the extra {extra}, of which {missing} is not installed: {how_to_install(extra)}"
        )
        raise NotInstalledError(text) from error


def how_to_install(extra: str) -> str:
    """Return the line that installs an extra."""
    return f"pip install 'flytrack[{extra}]'"


def describe(command: Command) -> str:
    """Return what stands above the flags of a command."""
    needed = (
        f"\n\nNeeds the extra {command.extra}: {how_to_install(command.extra)}"
        if command.extra
        else ""
    )
    return f"{command.summary}.{needed}"


def leave(name: str, status: int, text: object) -> NoReturn:
    """Exit with one line about a command."""
    print(f"{PROG} {name}: {' '.join(str(text).split())}", file=sys.stderr)
    raise SystemExit(status)


def call(name: str, words: Sequence[str]) -> None:
    """Run a command; what it refuses ends with one line and exit status 2."""
    command = COMMANDS[name]
    if (CLONE / "firmware").is_dir() and str(CLONE) not in sys.path:
        sys.path.append(str(CLONE))  # an editable installation finds only what a wheel has
    try:
        with loading_note(name):
            asked = words if command.reads_words else read_flags(name, words)
            run: Callable[[Any], int | None] = load(name, command.run)
    except NotInstalledError as error:
        if not {"-h", "--help"} & set(words):
            leave(name, REFUSED, f"error: {error}")
        print(
            f"usage: {PROG} {name} [OPTIONS]\n\n{describe(command)}\n\n"
            f"Its flags cannot be shown: {error}"
        )
        return
    warnings.showwarning = lambda message, *_, **__: print(
        f"{PROG} {name}: warning: {message}", file=sys.stderr
    )
    try:
        with held_output(asked):
            status = run(asked)
    except (ImportError, ValueError, OverflowError, OSError) as error:
        leave(name, REFUSED, f"error: {error}")
    except KeyboardInterrupt:
        leave(name, STOPPED, "stopped")
    if status:
        raise SystemExit(status)


@contextlib.contextmanager
def loading_note(name: str) -> Iterator[None]:
    """Say on a terminal that a command is being loaded, if that takes long.

    JAX and what builds on it take 3 s to import, and 9 s on a busy machine.
    """
    note = threading.Timer(
        LOADING_NOTE_S, lambda: print(f"{PROG} {name}: loading", file=sys.stderr, flush=True)
    )
    note.daemon = True
    if sys.stderr.isatty():
        note.start()
    try:
        yield
    finally:
        note.cancel()


def held_output(asked: Any) -> contextlib.AbstractContextManager[None]:
    """Return a lock of the command's output folder; a null context if it writes only files."""
    out = getattr(asked, "out", None)
    if not isinstance(out, Path) or out.suffix:
        return contextlib.nullcontext()
    from flytrack_env.files import locked_folder

    return locked_folder(out)


def read_flags(name: str, words: Sequence[str]) -> Any:
    """Return the flags of a command line as an instance of their dataclass."""
    import tyro

    command = COMMANDS[name]
    assert command.flags is not None
    config = (tyro.conf.FlagCreatePairsOff, tyro.conf.OmitArgPrefixes)
    flags, text = load(name, command.flags), describe(command)
    return tyro.cli(flags, args=words, prog=f"{PROG} {name}", description=text, config=config)


def print_completion(shell: str) -> None:
    """Print a shell's script that completes commands and flags.

    A command whose extra is not installed is completed without its flags.
    """
    import tyro

    def flags_of(name: str) -> Any:
        try:
            flags = load(name, COMMANDS[name].flags or ":")
        except (NotInstalledError, ValueError):
            flags = dataclasses.make_dataclass(name, [])
        return Annotated[flags, tyro.conf.subcommand(name, description=COMMANDS[name].summary)]

    config = (tyro.conf.FlagCreatePairsOff, tyro.conf.OmitArgPrefixes)
    script = ["--tyro-print-completion", shell]
    of_all: Any = Union[tuple(map(flags_of, COMMANDS))]  # noqa: UP007, made of a list
    text = io.StringIO()
    with contextlib.redirect_stdout(text), contextlib.suppress(SystemExit):
        tyro.cli(of_all, args=script, prog=PROG, config=config)
    for (
        line
    ) in text.getvalue().splitlines():  # shells read an end of line in a help as that of a word
        print(line.replace("\\n", " ") if line.startswith("COMPLETION_SPEC = ") else line)


def make_parser() -> argparse.ArgumentParser:
    """Return the parser of a line without a known command."""
    parser = argparse.ArgumentParser(
        prog=PROG,
        description="A drone-racing environment that tells you what your simulator gets wrong.",
        epilog="flytrack COMMAND --help shows a command's flags and the extra that it needs.",
    )
    parser.add_argument("--version", action="version", version=f"{PROG} {version(PROG)}")
    text = "print the script that makes a shell complete commands and flags"
    parser.add_argument("--print-completion", choices=SHELLS, help=text)
    commands = parser.add_subparsers(metavar="COMMAND", title="commands")
    for name, command in COMMANDS.items():
        commands.add_parser(name, help=command.summary, add_help=False)
    return parser


def main(arguments: Sequence[str] | None = None) -> None:
    """Run a command line; one without a command prints the commands, and exits with 2."""
    words = list(sys.argv[1:] if arguments is None else arguments)
    if words and words[0] in COMMANDS:
        call(words[0], words[1:])
        return
    parser = make_parser()
    asked = parser.parse_args(words)
    if asked.print_completion:
        print_completion(asked.print_completion)
    else:
        parser.print_help(sys.stderr)
        raise SystemExit(REFUSED)
