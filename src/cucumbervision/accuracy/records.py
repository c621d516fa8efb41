"""One line a measured fruit: what a benchmark stores, so that it can resume and be read again."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, field
from enum import StrEnum
from typing import TYPE_CHECKING, Any

from cucumbervision.errors import CucumberVisionError

if TYPE_CHECKING:
    from collections.abc import Iterable
    from pathlib import Path

__all__ = ["Masks", "Record", "Suite", "append_record", "read_records"]


class Suite(StrEnum):
    """Which part of the benchmark a capture belongs to."""

    PAPER = "paper"
    VALIDATION = "validation"
    STRESS = "stress"
    OWN = "own"


class Masks(StrEnum):
    """Whose masks and keypoints were measured."""

    EXACT = "exact"
    DISTURBED = "disturbed"
    PERCEIVED = "perceived"


@dataclass(frozen=True)
class Record:
    """One fruit of one capture, measured by everybody under the same conditions.

    Parameters
    ----------
    case : str
        The capture's name, unique within the suite.
    suite : Suite
        The part of the benchmark.
    masks : Masks
        Whose masks and keypoints.
    fruit : str
        The fruit; captures of one fruit are no independent samples.
    centreline_m, thread_m, chord_m : float or None
        True lengths in metres; None where only another was measured by hand.
    distance_m : float
        Distance of the fruit's middle from the camera, metres.
    tilt_deg : float
        Angle of its chord out of the picture plane, degrees, 0 to 90.
    bend_radius_m : float or None
        Radius of the axis' bend, metres; None for straight fruit.
    hidden_share : float
        Share of the outline's pixels that something hides, 0 to 1.
    fill : float
        Share of the mask's pixels with a reading, 0 to 1.
    condition : str
        'plain', 'sun', 'wet'.
    depth_scale : float
        The camera's true depth scale: what it reads over what is.
    lengths_m : dict of str to float or None
        What each read, metres; None where it refused. Keys: 'M1' … 'M5', 'M6' (centreline),
        'M6 thread', 'M6 chord', 'oracle', and other people's tools by name.
    details : dict
        What else was noted: 'm6_sd_m', 'm6_tilt_deg', 'm6_hidden_share', 'selected'
        (the selector's method), 'paper_selected', 'flags'.
    """

    case: str
    suite: Suite
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

    @property
    def key(self) -> tuple[str, str, str]:
        """What tells one record from another: suite, case, masks."""
        return str(self.suite), self.case, str(self.masks)


def append_record(path: Path, record: Record) -> None:
    """Append one record as a line of JSON, whole or not at all."""
    with path.open("a", encoding="utf-8") as stream:
        stream.write(json.dumps(asdict(record)) + "\n")


def read_records(paths: Iterable[Path]) -> list[Record]:
    """Read records back; a last line that a killed run left unfinished is passed over.

    Raises
    ------
    CucumberVisionError
        If another line is broken.

    Examples
    --------
    >>> import tempfile, pathlib
    >>> path = pathlib.Path(tempfile.mkdtemp()) / "a.jsonl"
    >>> one = Record("a", Suite.PAPER, Masks.EXACT, "f1", 0.2, 0.22, 0.2, 0.5, 0.0, None, 0.0, 1.0)
    >>> append_record(path, one)
    >>> read_records([path]) == [one]
    True
    """
    records = []
    for path in paths:
        lines = path.read_text(encoding="utf-8").splitlines()
        for number, line in enumerate(lines, 1):
            try:
                values = json.loads(line)
                values.update(suite=Suite(values["suite"]), masks=Masks(values["masks"]))
                records.append(Record(**values))
            except (ValueError, TypeError, KeyError) as error:
                if number == len(lines):
                    continue
                raise CucumberVisionError(
                    f"line {number} is no record ({error})",
                    source=path,
                    remedy="delete the line, or the file, and run again",
                ) from None
    return records
