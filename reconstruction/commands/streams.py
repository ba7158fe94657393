"""Standard output and standard error of a command: trouble with them does not end the work.

A pipe whose reader has gone (`simrecon list | head`), a full disk behind `>`, and streams that were closed before the
start are remembered, not raised. Characters that the stream's encoding lacks are written as escapes.
"""

import contextlib
import errno
import os
import sys
from collections.abc import Iterator
from typing import Any, TextIO

_GONE = (errno.EPIPE, errno.EBADF)  # nobody reads


class TolerantStream:
    """A text stream whose first failure is kept in `trouble`; later writes are dropped."""

    def __init__(self, stream: TextIO) -> None:
        self._stream = stream
        self.trouble: OSError | ValueError | None = None

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)

    def write(self, text: str) -> int:
        """Write text, unless the stream has failed; return its length."""
        if self.trouble is None:
            try:
                try:
                    self._stream.write(text)
                except UnicodeEncodeError:
                    encoding = self._stream.encoding or "ascii"
                    self._stream.write(text.encode(encoding, "backslashreplace").decode(encoding))
            except (OSError, ValueError) as error:  # ValueError: the stream is closed
                self.trouble = error
        return len(text)

    def writelines(self, lines: Any) -> None:
        """Write several texts."""
        for line in lines:
            self.write(line)

    def flush(self) -> None:
        """Flush, unless the stream has failed."""
        if self.trouble is None:
            try:
                self._stream.flush()
            except (OSError, ValueError) as error:
                self.trouble = error

    @property
    def loss(self) -> str:
        """Why output was lost that somebody wants: "" if none was, or nobody reads it."""
        if not isinstance(self.trouble, OSError) or self.trouble.errno in _GONE:
            return ""
        return self.trouble.strerror or str(self.trouble)


@contextlib.contextmanager
def tolerant_streams() -> Iterator[TolerantStream]:
    """Make `sys.stdout` and `sys.stderr` tolerant while the block runs; yield standard output."""
    for descriptor in range(3):  # a closed one would become that of the next file that is opened
        try:
            os.fstat(descriptor)
        except OSError:
            os.open(os.devnull, os.O_RDWR)
    before = sys.stdout, sys.stderr
    with open(os.devnull, "w") as nothing:  # noqa: PTH123 - no path
        out, err = TolerantStream(before[0] or nothing), TolerantStream(before[1] or nothing)
        sys.stdout, sys.stderr = out, err  # type: ignore[assignment]
        try:
            yield out
        finally:
            for stream in (out, err):
                stream.flush()
            sys.stdout, sys.stderr = before
            for stream, descriptor in ((out, 1), (err, 2)):
                if stream.trouble is not None:
                    _drop_rest(stream, descriptor)


def _drop_rest(stream: TolerantStream, descriptor: int) -> None:
    """Send what is left in the buffer nowhere, or the interpreter complains when it ends."""
    with contextlib.suppress(OSError, ValueError, AttributeError):
        if stream.fileno() == descriptor:
            nowhere = os.open(os.devnull, os.O_WRONLY)
            os.dup2(nowhere, descriptor)
            os.close(nowhere)
