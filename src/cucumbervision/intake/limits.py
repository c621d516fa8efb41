"""Limits of uploads."""

from __future__ import annotations

from dataclasses import dataclass, field, fields

_MB = 1_000_000
_GB = 1000 * _MB


@dataclass(frozen=True)
class RecordingLimits:
    """Limits of the process that plays a recording.

    Parameters
    ----------
    wall_s, cpu_s : float
        Wall time and CPU time, seconds.
    still_s : float
        Maximum time without output, seconds; the SDK may loop in a damaged file.
    memory_bytes : int
        Address space.
    output_bytes : int
        Total output, also the limit of a single file.
    captures : int
        Maximum number of captures per recording.
    """

    wall_s: float = 300.0
    cpu_s: float = 300.0
    still_s: float = 60.0
    memory_bytes: int = 6 * _GB
    output_bytes: int = 4 * _GB
    captures: int = 2000

    def __post_init__(self) -> None:
        _require_positive(self)


@dataclass(frozen=True)
class Limits:
    """Limits of an upload.

    Parameters
    ----------
    files : int
        Maximum number of files.
    file_bytes, total_bytes : int
        Maximum size of one file, and of all files.
    members : int
        Maximum number of files in all zips of an upload.
    unpacked_bytes : int
        Maximum unpacked size of all zips.
    ratio : float
        Maximum compression ratio of members larger than `ratio_from_bytes`; Deflate reaches 1032.
    ratio_from_bytes : int
        Size above which `ratio` applies.
    zip_depth : int
        Allowed nesting of zips: 1 allows a zip in a zip, 0 none.
    text_bytes : int
        Maximum size of a JSON, YAML, XML or text file.
    recording : RecordingLimits
        Limits for `.bag` and `.db3`.

    Raises
    ------
    ValueError
        If a limit is not positive (`zip_depth` may be 0).

    Examples
    --------
    >>> Limits(files=0)
    Traceback (most recent call last):
    ...
    ValueError: the limit 'files' is 0, which lets nothing in
    """

    files: int = 500
    file_bytes: int = 2 * _GB
    total_bytes: int = 4 * _GB
    members: int = 5000
    unpacked_bytes: int = 8 * _GB
    ratio: float = 200.0
    ratio_from_bytes: int = 4 * _MB
    zip_depth: int = 1
    text_bytes: int = 2 * _MB
    recording: RecordingLimits = field(default_factory=RecordingLimits)

    def __post_init__(self) -> None:
        _require_positive(self)


def _require_positive(limits: Limits | RecordingLimits) -> None:
    for one in fields(limits):
        value = getattr(limits, one.name)
        if isinstance(value, int | float) and value < (0 if one.name == "zip_depth" else 1e-9):
            raise ValueError(f"the limit '{one.name}' is {value}, which lets nothing in")
