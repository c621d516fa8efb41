"""Calibrations made on the pages: where they are kept, and what each does in a grower's words."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from statistics import fmean
from typing import TYPE_CHECKING

from cucumbervision.accuracy.calibration_file import (
    Form,
    read_site_calibration,
    write_site_calibration,
)
from cucumbervision.accuracy.own_truth import REPORTED, comparable
from cucumbervision.accuracy.site_calibration import calibrate_camera
from cucumbervision.capture.source import safe_name
from cucumbervision.errors import CalibrationError, CucumberVisionError, Message
from cucumbervision.methods.result import MethodName, calibration_key
from cucumbervision.names import checked_name
from cucumbervision_greenhouse.language import counted, decimal_words, number_words
from cucumbervision_greenhouse.language import gettext as _
from cucumbervision_greenhouse.rounds.stop_records import stored_capture
from cucumbervision_greenhouse.words import round_day

if TYPE_CHECKING:
    from collections.abc import Iterator

    from cucumbervision.accuracy.calibration_file import SiteCalibration
    from cucumbervision.accuracy.own_truth import OwnTruth
    from cucumbervision.capture.frames import Capture
    from cucumbervision.methods.result import LengthDefinition
    from cucumbervision_greenhouse.settings import Units
    from cucumbervision_greenhouse.store.repository import Store

_SUFFIX = ".calibration.json"


@dataclass(frozen=True)
class SavedCalibration:
    """A calibration file.

    Parameters
    ----------
    path : Path
        The file.
    site : SiteCalibration, optional
        Its content; None if it cannot be read.
    fault : str
        Why not.
    """

    path: Path
    site: SiteCalibration | None
    fault: str = ""

    @property
    def title(self) -> str:
        """Name and day of the calibration, or the file's name."""
        if self.site is None:
            return self.path.name
        return f"{self.site.name}, {round_day(_created_s(self.site))}"


def _created_s(site: SiteCalibration) -> float:
    try:
        created_s = datetime.fromisoformat(site.created).timestamp()
        datetime.fromtimestamp(created_s)  # may be a day of no calendar here
    except (ValueError, OverflowError, OSError):
        return 0.0
    return created_s


def save_calibration(folder: Path, site: SiteCalibration) -> Path:
    """Write a calibration into the folder of a store, under its name and the time; return the file.

    Raises
    ------
    CalibrationError
        If the file cannot be written.
    NameRefusedError
        If its name cannot be read.
    """
    moment = f"{datetime.now():%Y-%m-%d-%H%M%S-%f}"  # two viewers may make one at once
    name = safe_name(checked_name(site.name, "calibration's name"))
    path = folder / f"{moment}-{name}{_SUFFIX}"
    write_site_calibration(path, site)
    return path


def saved_calibrations(folder: Path, chosen: str = "") -> list[SavedCalibration]:
    """Return the calibrations of a folder, the newest first, and the chosen one wherever it is."""
    paths = {_resolved(path): path for path in folder.glob(f"*{_SUFFIX}")}
    if chosen:
        paths[_resolved(Path(chosen))] = Path(chosen)
    saved = [_saved(path) for path in paths.values()]
    return sorted(saved, key=lambda x: -_created_s(x.site) if x.site is not None else 0.0)


def _resolved(path: Path) -> Path:
    try:
        return path.resolve()
    except (OSError, ValueError, RuntimeError):  # typed: a loop of links, or no name of a file
        return path


def _saved(path: Path) -> SavedCalibration:
    try:
        return SavedCalibration(path, read_site_calibration(path))
    except CucumberVisionError as error:
        return SavedCalibration(path, None, str(error))


def effect_words(site: SiteCalibration, length: LengthDefinition, units: Units) -> str:
    """Return what a calibration does, for fruit with a fitted tube.

    Parameters
    ----------
    site : SiteCalibration
        The calibration.
    length : LengthDefinition
        Definition of the reported length.
    units : Units
        Unit of lengths.
    """
    words = []
    if site.depth_scale is not None:
        percent = 100 * (site.depth_scale.value - 1)
        words.append(
            counted(
                site.depth_scale.captures,
                "The camera reads {percent} % too long; that is taken out ({n} picture of a "
                "printed grid).",
                "The camera reads {percent} % too long; that is taken out ({n} pictures of a "
                "printed grid).",
                percent=number_words(abs(percent), 1),
            )
            if percent > 0
            else counted(
                site.depth_scale.captures,
                "The camera reads {percent} % too short; that is taken out ({n} picture of a "
                "printed grid).",
                "The camera reads {percent} % too short; that is taken out ({n} pictures of a "
                "printed grid).",
                percent=number_words(abs(percent), 1),
            )
        )
    entry = site.entry(calibration_key(MethodName.M6, length), length)
    if entry is not None:
        share = decimal_words(f"{100 * (entry.scale - 1):+.1f} %")
        offset = f"{'+' if entry.offset_m >= 0 else '−'} {units.text(abs(entry.offset_m))}"
        change = {
            Form.NONE: _("Lengths stay as they are"),
            Form.SCALE: _("Lengths change by {change}").format(change=share),
            Form.SCALE_OFFSET: _("Lengths change by {change}").format(change=f"{share} {offset}"),
        }[entry.form]
        words.append(
            counted(
                entry.fruit,
                "{change}: error {before} % before and {after} % after ({n} fruit measured by "
                "hand).",
                "{change}: error {before} % before and {after} % after ({n} fruit measured by "
                "hand, each left out in turn).",
                change=change,
                before=number_words(entry.error_before_percent, 1),
                after=number_words(entry.error_after_percent, 1),
            )
        )
    kind = {"centreline": _("centreline"), "thread": _("thread"), "chord": _("chord")}[length]
    return " ".join(words) or _("Corrects other lengths than the {kind}.").format(kind=kind)


def bias_words(own_truth: OwnTruth, units: Units) -> str:
    """Return how far the reported lengths are from those by hand, in a sentence.

    Only lengths of the definition that was measured by hand count.
    """
    pairs = [
        (length, reading.lengths_m.get(REPORTED))
        for length, reading in own_truth.pairs
        if comparable(REPORTED, length.kind, reading.kind)
    ]
    errors_m = [measured_m - length.length_m for length, measured_m in pairs if measured_m]
    if not errors_m:
        return _("None of these fruit has a length of the kind that was measured by hand.")
    mean_m, off_m = fmean(errors_m), fmean(map(abs, errors_m))
    parts = {"mean": units.text(abs(mean_m)), "off": units.text(off_m)}
    if mean_m > 0:
        return counted(
            len(errors_m),
            "{n} fruit: measured {mean} too long on average; a single fruit is {off} off.",
            "{n} fruit: measured {mean} too long on average; a single fruit is {off} off.",
            **parts,
        )
    return counted(
        len(errors_m),
        "{n} fruit: measured {mean} too short on average; a single fruit is {off} off.",
        "{n} fruit: measured {mean} too short on average; a single fruit is {off} off.",
        **parts,
    )


def calibrate_by_grid(store: Store, round_key: str, spacing_m: float, name: str) -> SiteCalibration:
    """Calibrate a camera from a round's pictures of a printed grid.

    Raises
    ------
    CalibrationError
        If the round was measured with a calibration, shows no grid, or has several cameras.
    """
    return calibrate_camera(_grid_captures(store, round_key), spacing_m, name)


def _grid_captures(store: Store, round_key: str) -> Iterator[Capture]:
    for summary in store.stops(round_key):
        stop = store.stop(summary.key)
        if any(artifact.kind == "calibration" for artifact in stop.artifacts):
            raise CalibrationError(
                "these pictures were measured with a calibration, which changed their depth",
                source=Message("this round"),
                remedy="choose no calibration, begin a round and take pictures of the grid again",
            )
        for record in stop.captures:
            yield stored_capture(store.images, record, stop)
