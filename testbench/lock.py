"""A lock that one process has and the system takes back when it ends, however that was."""

import os
import sys
from pathlib import Path
from typing import Final, final

if sys.platform == "win32":
    import msvcrt
else:
    import fcntl


@final
class Lock:
    """A lock on a file beside what it is about; the file stays, and holds the number of the last process."""

    def __init__(self, path: Path) -> None:
        self._path: Final[Path] = path
        self._file: int = -1

    def acquire(self, note: bool = True) -> int | None:
        """Take it; the process that has it otherwise (0 when it cannot be told). May raise OSError.

        note: write this process's number into the file.
        """
        file = os.open(self._path, os.O_RDWR | os.O_CREAT, 0o666)
        try:
            if sys.platform == "win32":
                os.lseek(file, 64, os.SEEK_SET)  # beyond the number, which others must be able to read
                msvcrt.locking(file, msvcrt.LK_NBLCK, 1)
            else:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            os.lseek(file, 0, os.SEEK_SET)
            text = os.read(file, 32).decode("ascii", "replace").strip()
            os.close(file)
            return int(text) if text.isdecimal() else 0
        self._file = file
        if note:
            os.ftruncate(file, 0)
            os.lseek(file, 0, os.SEEK_SET)
            os.write(file, f"{os.getpid()}\n".encode())
        return None

    def release(self) -> None:
        """Give it back; does nothing when it is not held."""
        if self._file >= 0:
            os.close(self._file)
            self._file = -1


def is_locked(path: Path) -> bool:
    """Whether a process has the lock now. May raise OSError."""
    if not path.exists():
        return False
    lock = Lock(path)
    if lock.acquire(note=False) is not None:
        return True
    lock.release()
    return False
