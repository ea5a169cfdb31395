"""Ask a process that answers each line with a line: one loop with a deadline for both pipes."""

import os
import selectors
import shlex
import signal
import subprocess
import time
from contextlib import suppress
from math import nan
from pathlib import Path
from typing import IO

from nextview.checks import one_line
from nextview.errors import ResultsError, UsageError

LONGEST_LINE = 1 << 20  # bytes
READ_AT_ONCE = 1 << 16  # bytes
LOOKED_AFTER = 0.1  # seconds between two looks at whether the process is there
ENDING = 5.0  # seconds that a process has to end when its input does
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
        self._said = b""  # what was read beyond the last answer

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
        with suppress(BlockingIOError):
            self._said += os.read(self._output.fileno(), READ_AT_ONCE)
        self._refuse_unasked(where)

        unsent = memoryview(line + b"\n")
        with selectors.DefaultSelector() as pipes:
            pipes.register(self._input, selectors.EVENT_WRITE)
            pipes.register(self._output, selectors.EVENT_READ)
            while b"\n" not in self._said and len(self._said) <= LONGEST_LINE:
                left = deadline - time.monotonic()
                if left <= 0:
                    raise ResultsError(f"{where}: no answer in {wait:g} s (--wait)")
                ready = pipes.select(min(left, LOOKED_AFTER))
                if not ready and self._process.poll() is not None:
                    raise self._ended(where)
                for key, _ in ready:
                    if key.fileobj is self._output:
                        part = os.read(self._output.fileno(), READ_AT_ONCE)
                        if not part:
                            raise self._ended(where)
                        self._said += part
                        continue
                    try:
                        unsent = unsent[os.write(self._input.fileno(), unsent) :]
                    except BrokenPipeError:
                        raise self._ended(where) from None
                    if not unsent:
                        pipes.unregister(self._input)

        if unsent:
            self._refuse_unasked(where)
        said, _, self._said = self._said.partition(b"\n")
        if len(said) > LONGEST_LINE:
            raise ResultsError(
                f"{where}: {quoted(said)} is a line of more than {LONGEST_LINE >> 20} MB"
            )
        try:
            said.decode()
        except UnicodeDecodeError as error:
            byte = said[error.start]
            raise ResultsError(
                f"{where}: {quoted(said)} is not UTF-8 (byte {byte:#04x})"
            ) from None
        return said

    def cpu_seconds(self) -> float:
        """Return the CPU time of the process and of those that it has waited for, seconds.

        It is NaN where the system does not tell: only Linux does.
        """
        try:
            text = Path(f"/proc/{self._process.pid}/stat").read_text(errors="replace")
        except OSError:
            return nan
        ticks = map(int, text.rpartition(")")[2].split()[11:15])
        return sum(ticks) / os.sysconf("SC_CLK_TCK")

    def close(self) -> bytes:
        """End the process: its input ends, and what is left of it after 5 s is stopped.

        Returns:
            What it wrote that nobody asked for.
        """
        if self._output.closed:
            return b""
        try:
            rest = self._process.communicate(timeout=ENDING)[0]
        except subprocess.TimeoutExpired as error:
            rest = error.output
        finally:
            # also where it has ended: it may have left others in its session
            with suppress(ProcessLookupError, PermissionError):
                os.killpg(self._process.pid, signal.SIGKILL)
            self._process.wait()
            self._output.close()
        return self._said + (rest or b"")

    def _refuse_unasked(self, where: str) -> None:
        """Raise a ResultsError if the process wrote more than its answer."""
        if self._said:
            raise ResultsError(
                f"{where}: {quoted(self._said)} was written before this view was sent;"
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
