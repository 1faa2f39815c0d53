"""The firmware's processes: one that is configured and ready, and a copy of it for every flight.

Requests and replies are those of ``lockstep.c``, over a socket that is a process's standard input.
No time passes in a process but what a request asks for. A process whose host is gone ends.
"""

import contextlib
import os
import shutil
import signal
import socket
import struct
import subprocess
import tempfile
from pathlib import Path
from typing import NamedTuple

import numpy as np

from firmware.body import Body, FirmwareError
from firmware.settings import Setting, check_read_back, configure, value_of, values_of

CLI, BODY, START, FLY, FORK = range(5)
REQUEST = struct.Struct("=5I8f")
REPLY = struct.Struct("=3I16x2f4x21d")  # without the motors' pulses
START_STATE = struct.Struct("=14dQ")
MAX_PID = 2**31 - 1  # a fork that failed has -1, unsigned
ARMED = 1  # of the firmware's armingFlags
FRAME_US = 10_000  # between two frames of the receiver: one per step of FlyTrack
LINE_US, BOOT_US = 15_000, 2_000_000
READY_US = 6_000_000  # until it may be armed
DUMP_US = 400_000
MAX_ANSWER_S = 60.0  # of the clock, for at most 6 s of the firmware's, which take 0.1
AT_REST = (1500.0, 1500.0, 950.0, 1500.0, *[1000.0] * 4)  # us, AETR and switches; below min_check
PROMPT = "# "


class Reply(NamedTuple):
    """What a process answers.

    is_armed. pid: of a copy. text: of the command line, or why it does not arm. motor_range: (2,),
    what the mixer may ask for, us. numbers: (21,): position, velocity, acceleration, quaternion,
    rates, motor speeds, V under load.
    """

    is_armed: bool
    pid: int
    text: str
    motor_range: np.ndarray
    numbers: np.ndarray


class Link:
    """One end of a process's socket: ``ask`` sends, ``answer`` waits.

    Both raise FirmwareError if the process ends or hangs.
    """

    def __init__(self, end: socket.socket, name: str):
        self.end, self.name, self.pid = end, name, 0
        end.settimeout(MAX_ANSWER_S)

    def ask(
        self,
        kind: int,
        duration_us: int = 0,
        rc: tuple[float, ...] = AT_REST,
        payload: bytes = b"",
        is_held: bool = False,
        passed: socket.socket | None = None,
    ) -> None:
        """Send a request.

        Args:
            duration_us: how long the firmware flies or types.
            passed: a socket for the copy.
        """
        frame_us = FRAME_US if kind == FLY else 0
        packed = REQUEST.pack(kind, duration_us, frame_us, is_held, len(payload), *rc) + payload
        try:
            if passed is None:
                self.end.sendall(packed)
            else:
                socket.send_fds(self.end, [packed], [passed.fileno()])
        except OSError as error:
            raise self._lost(error) from error

    def answer(self) -> Reply:
        """Return the reply to the last request."""
        fields = REPLY.unpack(self._read(REPLY.size))
        arming, pid, num_bytes = fields[:3]
        text = self._read(num_bytes).decode(errors="replace")
        numbers = np.array(fields[3:])
        return Reply(bool(arming & ARMED), pid, text, numbers[:2], numbers[2:])

    def call(self, kind: int, **arguments: object) -> Reply:
        """Ask and return the answer."""
        self.ask(kind, **arguments)  # type: ignore[arg-type]
        return self.answer()

    def _read(self, size: int) -> bytes:
        parts, left = [], size
        while left:
            try:
                parts.append(self.end.recv(min(left, 2**16)))
            except OSError as error:
                raise self._lost(error) from error
            if not parts[-1]:
                raise self._lost(None)
            left -= len(parts[-1])
        return b"".join(parts)

    def _lost(self, error: OSError | None) -> FirmwareError:
        if isinstance(error, TimeoutError):
            self.kill()
            return FirmwareError(
                f"firmware: {self.name} did not answer within {MAX_ANSWER_S:g} s; it was ended"
            )
        return FirmwareError(f"firmware: {self.name} has ended by itself")

    def kill(self) -> None:
        """End a copy at once; one that has ended is left alone."""
        self.end.close()
        if self.pid:
            with contextlib.suppress(OSError):
                os.kill(self.pid, signal.SIGKILL)
            self.pid = 0


class Firmware:
    """The firmware with its settings, ready to be armed, in a process that is copied for flights.

    Attributes:
        values: every setting it has, by scope, profile and name.
        is_reversed: ``yaw_motors_reversed``.
    """

    def __init__(self, executable: Path, settings: list[Setting], body: Body):
        self.executable = executable
        self.folder = Path(tempfile.mkdtemp(prefix="flytrack_firmware_"))
        self.process: subprocess.Popen[bytes] | None = None
        self.settings = settings
        try:
            self._configure(settings)
            self.is_reversed = self.value("yaw_motors_reversed") == "ON"
            self._start()
            self.link.call(BODY, payload=body.pack(self.is_reversed))
            self.link.call(
                START, payload=START_STATE.pack(*[0.0] * 6, 1.0, *[0.0] * 6, body.full_v, 1)
            )
            self.link.call(FLY, duration_us=READY_US, is_held=True)
        except BaseException:
            self.close()
            raise

    def value(self, name: str) -> str:
        """Return the value of a setting in the selected profiles; '' for an unknown name."""
        last = self.settings[-1]
        return value_of(self.values, last._replace(name=name)) or ""

    def copy(self, folder: Path, name: str) -> Link:
        """Return the link to a copy in its own folder, which continues from the ready state."""
        ours, theirs = socket.socketpair()
        try:
            self.link.ask(FORK, payload=str(folder).encode(), passed=theirs)
            pid = self.link.answer().pid
        finally:
            theirs.close()
        link = Link(ours, name)
        if not 0 < pid <= MAX_PID:
            link.kill()
            raise FirmwareError(
                "firmware: its process cannot be copied: no memory, or too many processes"
            )
        link.pid = pid
        link.answer()
        return link

    def _configure(self, settings: list[Setting]) -> None:
        self._start()
        self._open_command_line()
        configure(settings, self._type)
        self.link.ask(CLI, duration_us=BOOT_US, payload=b"save\r\n")
        with contextlib.suppress(FirmwareError):
            self.link.answer()  # the firmware ends, to be started again
        self._start()
        self._open_command_line()
        dump = self._type("dump all", DUMP_US)
        check_read_back(settings, dump)
        self.values = values_of(dump)

    def _open_command_line(self) -> None:
        self.link.call(CLI, duration_us=BOOT_US)
        if not self.link.call(CLI, duration_us=BOOT_US, payload=b"#").text.endswith(PROMPT):
            raise FirmwareError("firmware: its command line did not open")

    def _type(self, line: str, duration_us: int = LINE_US) -> str:
        """Type a line and return what it answers, up to the next prompt."""
        answer = self.link.call(CLI, duration_us=duration_us, payload=f"{line}\r\n".encode()).text
        if not answer.endswith(PROMPT):
            raise FirmwareError(f"firmware: its command line did not finish {line!r}")
        return answer

    def _start(self) -> None:
        self._stop()
        ours, theirs = socket.socketpair()
        with theirs, (self.folder / "firmware.log").open("ab") as log:
            try:
                self.process = subprocess.Popen(
                    [self.executable],
                    cwd=self.folder,
                    stdin=theirs.fileno(),
                    stdout=subprocess.DEVNULL,
                    stderr=log,
                    start_new_session=True,
                )
            except OSError as error:
                ours.close()
                raise FirmwareError(
                    f"{self.executable}: cannot be started: {error.strerror}"
                ) from error
        self.link = Link(ours, "its process")

    def _stop(self) -> None:
        """End the process and every copy of it."""
        if self.process is None:
            return
        self.link.end.close()
        with contextlib.suppress(OSError):  # the session that _start began
            os.killpg(self.process.pid, signal.SIGKILL)
        self.process.wait()
        self.process = None

    def close(self) -> None:
        """End everything, and remove its folder."""
        self._stop()
        shutil.rmtree(self.folder, ignore_errors=True)
