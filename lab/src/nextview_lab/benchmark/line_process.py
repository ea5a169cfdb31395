"""Ask a process that answers each line with a line: one loop with a deadline for both of its pipes.

What is kept of its output is at most one line and what was read beyond it, whatever it writes.
"""

import codecs
import os
import selectors
import shlex
import signal
import subprocess
import time
from contextlib import suppress
from math import inf, nan
from pathlib import Path
from typing import IO, NamedTuple

from nextview.checks import one_line
from nextview.errors import ResultsError, UsageError

LONGEST_LINE = 1 << 20  # bytes
READ_AT_ONCE = 1 << 16  # bytes
LOOKED_AFTER = 0.1  # seconds between two looks at whether the process is there
ENDING = 5.0  # seconds that a process has to end when its input does
SNAPSHOTS = 5  # of the processes, two of which in a row have to agree
ONE_LINE = (
    "standard output is for one line a view, and all else belongs to standard error"
)


class LineProcess:
    """A process that reads lines on its standard input and answers each on its standard output.

    What it writes to standard error is shown. It has a session of its own, and all of it that is
    left at the end is stopped.
    """

    def __init__(self, command: str) -> None:
        """Start the process.

        Args:
            command: as in a shell, such as "python my_method.py".

        Raises:
            UsageError: the command cannot be started.
        """
        self.command = one_line(command)
        if os.name != "posix":
            raise UsageError(
                f"{self.command}: other processes run on Linux and macOS only"
            )
        try:
            self._process = subprocess.Popen(
                shlex.split(command),
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                bufsize=0,
                start_new_session=True,
            )
        except (OSError, ValueError, IndexError) as error:
            raise UsageError(f"{self.command}: cannot be started ({error})") from None

        assert self._process.stdin is not None
        assert self._process.stdout is not None
        self._input: IO[bytes] = self._process.stdin
        self._output: IO[bytes] = self._process.stdout
        for pipe in (self._input, self._output):
            os.set_blocking(pipe.fileno(), False)
        self._unasked = b""  # what was read beyond the last answer
        self._counted: dict[int, _Used] = {}
        self._least = 0.0  # seconds of CPU: what was counted before

    def ask(self, line: bytes, wait: float, where: str) -> bytes:
        """Send a line, and return the line that answers it.

        Args:
            line: to send, without its end.
            wait: seconds to wait until the answer is complete.
            where: beginning of the sentence of an error.

        Returns:
            The answer, without its end.

        Raises:
            ResultsError: the process had written something before, has ended, says nothing in time,
                or what it says is too long or not UTF-8.
        """
        deadline = time.monotonic() + wait
        self._unasked += self._read() or b""
        self._refuse_unasked(where)

        unsent = memoryview(line + b"\n")
        said = bytearray()
        decoder = codecs.getincrementaldecoder("utf-8")()
        with selectors.DefaultSelector() as pipes:
            pipes.register(self._input, selectors.EVENT_WRITE)
            pipes.register(self._output, selectors.EVENT_READ)
            while True:
                left = deadline - time.monotonic()
                if left <= 0:
                    raise ResultsError(f"{where}: no answer in {wait:g} s (--wait)")
                # asked before the pipes: what it wrote before it ended is still read
                gone = self._process.poll() is not None
                ready = pipes.select(0 if gone else min(left, LOOKED_AFTER))
                files = [key.fileobj for key, _ in ready]

                if self._output in files:
                    part = self._read()
                    if part == b"":
                        raise self._ended(where)
                    if unsent:
                        self._unasked = part or b""
                        self._refuse_unasked(where)
                    one, end, self._unasked = (part or b"").partition(b"\n")
                    said += one
                    _check_text(said, one, decoder, bool(end), where)
                    if end:
                        return bytes(said)
                elif gone:
                    raise self._ended(where)

                if self._input in files:
                    try:
                        with suppress(BlockingIOError):
                            unsent = unsent[os.write(self._input.fileno(), unsent) :]
                    except BrokenPipeError:
                        raise self._ended(where) from None
                    if not unsent:
                        pipes.unregister(self._input)

    def cpu_seconds(self) -> float:
        """Return the CPU time of the process and all that it has started, seconds.

        Counted are the processes of its session and their descendants: those that run, and those
        that ended and that their parent has waited for. The time is NaN where the system does not
        tell (only Linux does), and from when one ended that no parent was left to wait for.
        """
        now = _counted(self._process.pid)
        if not now:
            return nan
        ended = [used for pid, used in self._counted.items() if pid not in now]
        if any(used.parent not in self._counted for used in ended):
            self._least = inf  # never known again
        ticks = sum(used.own + used.waited for used in now.values())
        seconds = ticks / os.sysconf("SC_CLK_TCK")
        if seconds < self._least:
            return nan
        self._counted = now
        self._least = seconds
        return seconds

    def close(self) -> bytes:
        """End the process: its input ends, and what is left of it after 5 s is stopped.

        Returns:
            What it wrote that nobody asked for, its beginning.
        """
        if self._output.closed:
            return b""
        self._input.close()
        deadline = time.monotonic() + ENDING
        rest = self._unasked
        try:
            while time.monotonic() < deadline and len(rest) < LONGEST_LINE:
                gone = self._process.poll() is not None
                part = self._read()
                rest += part or b""
                if gone and not part:
                    break
                if not part:
                    time.sleep(LOOKED_AFTER / 10)
        finally:
            # also where it has ended: it may have left others in its session
            with suppress(ProcessLookupError, PermissionError):
                os.killpg(self._process.pid, signal.SIGKILL)
            self._process.wait()
            self._output.close()
        return rest

    def _read(self) -> bytes | None:
        """Read what lies in the pipe: None for nothing, empty at its end."""
        try:
            return os.read(self._output.fileno(), READ_AT_ONCE)
        except BlockingIOError:
            return None

    def _refuse_unasked(self, where: str) -> None:
        """Raise a ResultsError if the process wrote more than its answer."""
        if self._unasked:
            raise ResultsError(
                f"{where}: {quoted(self._unasked)} was written before this view was sent;"
                f" {ONE_LINE}"
            )

    def _ended(self, where: str) -> ResultsError:
        """Return the error of a process that answers no more."""
        try:
            status = self._process.wait(2 * LOOKED_AFTER)
        except subprocess.TimeoutExpired:
            return ResultsError(
                f"{where}: the process has closed its input or its output"
            )
        return ResultsError(
            f"{where}: the process has ended with status {status}; see what it said"
        )


def quoted(said: bytes) -> str:
    """Return the first line of an output as a sentence quotes it.

    Args:
        said: the output.
    """
    first = said.partition(b"\n")[0][:LONGEST_LINE]
    text = one_line(first.decode("utf-8", "backslashreplace"))
    return f"'{text}'" if text else "an empty line"


def _check_text(
    said: bytearray,
    new: bytes,
    decoder: codecs.IncrementalDecoder,
    whole: bool,
    where: str,
) -> None:
    """Check what was read of a line, ``new`` of it now; ResultsError."""
    try:
        decoder.decode(new, final=whole)
    except UnicodeDecodeError as error:
        byte = error.object[error.start]
        raise ResultsError(
            f"{where}: {quoted(bytes(said))} is not UTF-8 (byte {byte:#04x})"
        ) from None
    if len(said) > LONGEST_LINE:
        raise ResultsError(
            f"{where}: {quoted(bytes(said))} is a line of more than"
            f" {LONGEST_LINE >> 20} MB"
        )


class _Used(NamedTuple):
    """A process: its parent, its session, and ticks of CPU, its own and those it waited for."""

    parent: int
    session: int
    own: int
    waited: int


def _counted(leader: int) -> dict[int, _Used]:
    """Return the processes of a session and their descendants; none where that is not known.

    The time of one that ends moves to its parent, and could be counted twice or not at all: two
    looks in a row agree about who is there and who has been waited for.

    Args:
        leader: process that leads the session.
    """
    before = _members(leader)
    for _ in range(SNAPSHOTS - 1):
        now = _members(leader)
        if {pid: used.waited for pid, used in now.items()} == {
            pid: used.waited for pid, used in before.items()
        }:
            return now
        before = now
    return {}


def _members(leader: int) -> dict[int, _Used]:
    """Return the processes of a session and their descendants, by their numbers."""
    there = {}
    for place in Path("/proc").glob("[0-9]*"):
        # one that has ended meanwhile
        with suppress(OSError):
            text = (place / "stat").read_text(encoding="utf-8", errors="replace")
            values = text.rpartition(")")[2].split()
            user, kernel, waited_user, waited_kernel = map(int, values[11:15])
            there[int(place.name)] = _Used(
                int(values[1]),
                int(values[3]),
                user + kernel,
                waited_user + waited_kernel,
            )

    members = {pid for pid, used in there.items() if used.session == leader}
    more = members
    while more:
        more = {pid for pid, used in there.items() if used.parent in more} - members
        members |= more
    return {pid: there[pid] for pid in members}
