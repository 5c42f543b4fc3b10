"""Peak memory of a stretch of work in this process."""

from __future__ import annotations

import resource
import sys
from contextlib import suppress
from pathlib import Path

CLEAR_REFS = Path("/proc/self/clear_refs")
STATUS = Path("/proc/self/status")

# ru_maxrss counts bytes on macOS and kibibytes elsewhere.
BYTES_PER_RSS_UNIT = 1 if sys.platform == "darwin" else 1024


class PeakMemory:
    """Largest resident memory since this object was made, where the system can tell.

    Linux resets its high-water mark on request; elsewhere the mark is that of the whole process.
    """

    def __init__(self) -> None:
        self._resettable = False
        with suppress(OSError):
            CLEAR_REFS.write_text("5")
            self._resettable = True

    def megabytes(self) -> float:
        """The peak in megabytes (10^6 bytes)."""
        if self._resettable:
            for line in STATUS.read_text().splitlines():
                if line.startswith("VmHWM:"):
                    return int(line.split()[1]) * 1024 / 1e6
        usage = resource.getrusage(resource.RUSAGE_SELF)
        return usage.ru_maxrss * BYTES_PER_RSS_UNIT / 1e6
