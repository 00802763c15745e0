"""Resident memory of this process, from Linux's /proc."""

from pathlib import Path


def reset_peak_mb() -> float:
    """Forget the largest size so far; gives the present one, in MiB."""
    Path("/proc/self/clear_refs").write_text("5")
    return peak_mb()


def peak_mb() -> float:
    """The largest size since then, in MiB."""
    return _status("VmHWM") / 1024


def resident_bytes() -> int:
    """The present size."""
    return 1024 * _status("VmRSS")


def _status(name: str) -> int:
    line = next(row for row in Path("/proc/self/status").read_text().splitlines() if row.startswith(name))
    return int(line.split()[1])
