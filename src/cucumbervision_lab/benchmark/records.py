"""Records of measured fruit with true lengths, as JSON lines and as a data frame."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, field
from enum import StrEnum
from importlib.util import find_spec
from typing import TYPE_CHECKING, Any

from cucumbervision.errors import CucumberVisionError, MissingExtraError, wrap_reader_errors
from cucumbervision.files import parse_model, read_text

if TYPE_CHECKING:
    from collections.abc import Iterable
    from pathlib import Path

    import pandas as pd

_NUMBERS = (
    *("centreline_m", "thread_m", "chord_m", "distance_m", "tilt_deg", "bend_radius_m"),
    *("hidden_share", "fill", "depth_scale", "length_m"),
)


class Masks(StrEnum):
    """Kind of masks and keypoints."""

    EXACT = "exact"
    DISTURBED = "disturbed"
    PERCEIVED = "perceived"


@dataclass(frozen=True)
class LengthRecord:
    """One fruit of one capture, measured by every method under the same conditions.

    Parameters
    ----------
    case : str
        Name of the capture, unique within the suite.
    suite : str
        Part of the benchmark.
    masks : Masks
        Kind of masks and keypoints.
    fruit : str
        Name of the fruit; captures of one fruit are not independent samples.
    centreline_m, thread_m, chord_m : float or None
        True lengths in metres; None if unknown.
    distance_m : float
        Distance of the fruit's centre from the camera, metres.
    tilt_deg : float
        Angle between chord and picture plane, degrees, 0 to 90.
    bend_radius_m : float or None
        Radius of curvature of the axis, metres; None for straight fruit.
    hidden_share : float
        Occluded share of the fruit's pixels, 0 to 1.
    fill : float
        Share of the mask's pixels with a depth reading, 0 to 1.
    condition : str
        'plain', 'sun', 'wet'.
    depth_scale : float
        Depth scale of the camera, the ratio of measured to true depth.
    lengths_m : dict of str to float or None
        Length by each method, metres; None if it failed, no key if it was not run. Keys: 'M1' …
        'M5', 'M6' (centreline), 'M6 thread', 'M6 chord', selectors and baselines.
    details : dict
        Further values by name.
    """

    case: str
    suite: str
    masks: Masks
    fruit: str
    centreline_m: float | None
    thread_m: float | None
    chord_m: float | None
    distance_m: float
    tilt_deg: float
    bend_radius_m: float | None
    hidden_share: float
    fill: float
    condition: str = "plain"
    depth_scale: float = 1.0
    lengths_m: dict[str, float | None] = field(default_factory=dict)
    details: dict[str, Any] = field(default_factory=dict)


def append_record(path: Path, record: LengthRecord) -> None:
    """Append a record as a line of JSON in a single write."""
    with path.open("a", encoding="utf-8") as stream:
        stream.write(json.dumps(asdict(record)) + "\n")


def read_records(paths: Iterable[Path]) -> list[LengthRecord]:
    """Read records; an incomplete last line of an interrupted run is skipped.

    Raises
    ------
    CucumberVisionError
        If another line is invalid.

    Examples
    --------
    >>> import tempfile, pathlib
    >>> path = pathlib.Path(tempfile.mkdtemp()) / "a.jsonl"
    >>> facts = 0.2, 0.22, 0.2, 0.5, 0.0, None, 0.0, 1.0
    >>> record = LengthRecord("a", "paper", Masks.EXACT, "f1", *facts)
    >>> append_record(path, record)
    >>> read_records([path]) == [record]
    True
    """
    records = []
    for path in paths:
        lines = read_text(path, CucumberVisionError).split("\n")
        for number, line in enumerate(lines, 1):
            if not line.strip():
                continue
            place, remedy = f"{path}, line {number}", "delete the line, or the file, and run again"
            try:
                with wrap_reader_errors(place, remedy=remedy):
                    values = json.loads(line)
                records.append(
                    parse_model(LengthRecord, values, source=place, error=CucumberVisionError)
                )
            except CucumberVisionError:
                if number == len(lines):
                    continue
                raise
    return records


def readings_frame(records: Iterable[LengthRecord]) -> pd.DataFrame:
    """Return records as a data frame with one row per record and method.

    Parameters
    ----------
    records : iterable of LengthRecord
        Records with at least one length.

    Returns
    -------
    DataFrame
        The fields of `LengthRecord` except `lengths_m` and `details`, unknown numbers as NaN;
        `method` and `length_m` (metres, NaN if the method failed); and a column for each key of
        `details`.

    Raises
    ------
    MissingExtraError
        As `require_extra`.

    Examples
    --------
    >>> read = {"M1": 0.19, "M6": None}
    >>> facts = 0.2, None, None, 0.5, 0.0, None, 0.0, 1.0
    >>> record = LengthRecord("a", "paper", Masks.EXACT, "f1", *facts, lengths_m=read)
    >>> readings_frame([record])[["case", "method", "length_m", "centreline_m", "thread_m"]]
      case method  length_m  centreline_m  thread_m
    0    a     M1      0.19           0.2       NaN
    1    a     M6       NaN           0.2       NaN
    """
    require_extra()
    import pandas as pd

    rows = []
    for record in records:
        shared = {**vars(record), **record.details}
        del shared["lengths_m"], shared["details"]
        rows += [
            shared | {"method": method, "length_m": length_m}
            for method, length_m in record.lengths_m.items()
        ]
    with wrap_reader_errors("the records", remedy="run the benchmark again"):
        return pd.DataFrame(rows).astype(dict.fromkeys(_NUMBERS, float))


def require_extra() -> None:
    """Check that pandas is installed.

    Raises
    ------
    MissingExtraError
        If it is not.
    """
    if find_spec("pandas") is None:
        raise MissingExtraError("pandas", "benchmark")
