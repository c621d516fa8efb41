"""Recall and precision on audited real photos; of the photos themselves nothing is kept."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from cucumbervision.capture.files import read_color
from cucumbervision_lab.detection.groups import GroupScore, overall
from cucumbervision_lab.detection.outcomes import FoundRow, FruitRow, found_rows, fruit_rows
from cucumbervision_lab.detection.picture_result import detect_picture
from cucumbervision_lab.detection.pictures import Frame, TrueFruit

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence
    from pathlib import Path

    from cucumbervision_lab.detection.picture_result import Networks

__all__ = ["Photo", "PhotoResult", "audited_photos", "evaluate_photos", "score_photos"]


@dataclass(frozen=True)
class PhotoResult:
    """What the networks found on real photos, as figures.

    Parameters
    ----------
    confidence : float
        At which they were judged.
    photos, scenes, missing : int
        How many were judged, of how many scenes, and how many of the audit's are not there.
    scores : tuple of (str, GroupScore)
        Recall and precision of all photos, and by where the fruit lies.
    fruit, found : tuple
        What they are of.
    """

    confidence: float
    photos: int
    scenes: int
    missing: int
    scores: tuple[tuple[str, GroupScore], ...]
    fruit: tuple[FruitRow, ...]
    found: tuple[FoundRow, ...]


@dataclass(frozen=True, eq=False)
class Photo:
    """An audited photo.

    Parameters
    ----------
    truth : Frame
        What is to be found, may be found, and is ignored.
    path : Path
        Where the file lies.
    setting : str
        Where the fruit lies: 'board', 'cart', 'plant' …
    """

    truth: Frame
    path: Path
    setting: str


def audited_photos(folder: Path, split: str = "test") -> tuple[list[Photo], int]:
    """Return the audited photos of a folder.

    Parameters
    ----------
    folder : Path
        Searched with its subfolders.
    split : str
        'test', whose scenes nobody trained on.

    Returns
    -------
    photos : list of Photo
        A courgette may be found, once, but need not.
    missing : int
        How many of the audit's photos are not there.

    Raises
    ------
    DataSetError
        If none is.
    """
    from cucumbervision_lab.detection.photo_audit import audited, load_audit

    data = audited(folder, split)
    photos = []
    for picture in data.pictures:
        true = tuple(
            TrueFruit(
                label.box,
                ignore=label.ignore,
                optional=label.extras["kind"] == "zucchini",
                cut_off=label.cut_off,
            )
            for label in picture.labels
        )
        truth = Frame(picture.file, picture.scene, picture.width, picture.height, true)
        photos.append(Photo(truth, data.path(picture), picture.extras["setting"]))
    return photos, len(load_audit().in_split(split)) - len(photos)


def evaluate_photos(
    photos: Sequence[Photo],
    networks: Networks,
    missing: int = 0,
    report: Callable[[int], None] | None = None,
) -> PhotoResult:
    """Run the networks on photos and score what they found.

    Parameters
    ----------
    photos : sequence of Photo
        From `audited_photos`.
    networks : Networks
        The networks.
    missing : int
        How many photos of the audit are not there.
    report : callable, optional
        Called with 1 after each photo.

    Raises
    ------
    CaptureError
        If a photo cannot be read.
    """
    frames = []
    for photo in photos:
        frames.append(detect_picture(photo.truth, read_color(photo.path), networks).frame)
        if report is not None:
            report(1)
    return score_photos(frames, [photo.setting for photo in photos], networks.confidence, missing)


def score_photos(
    frames: Sequence[Frame], settings: Sequence[str], confidence: float, missing: int = 0
) -> PhotoResult:
    """Score what was found on photos.

    Parameters
    ----------
    frames : sequence of Frame
        Truth and detections.
    settings : sequence of str
        Where the fruit of each lies.
    confidence : float
        At which to judge.
    missing : int
        How many photos of the audit are not there.

    Examples
    --------
    >>> import numpy as np
    >>> from cucumbervision_lab.detection.pictures import Frame, SeenFruit, TrueFruit
    >>> boxes = np.array([[0.0, 0, 50, 10], [0, 20, 50, 30], [0, 40, 50, 50]])
    >>> true = (TrueFruit(boxes[0]), TrueFruit(boxes[1], optional=True))
    >>> seen = tuple(SeenFruit(box, 0.9) for box in boxes)
    >>> found = score_photos([Frame("a.jpg", "s1", 60, 60, true, kept=seen)], ["board"], 0.3)
    >>> found.scores[0][1].recall.value, found.scores[0][1].precision.value
    (1.0, 0.5)
    """
    parts = {"all": list(frames)}
    for setting in sorted(set(settings)):
        own = [f for f, where in zip(frames, settings, strict=True) if where == setting]
        parts[setting] = own
    return PhotoResult(
        confidence,
        len(frames),
        len({frame.scene for frame in frames}),
        missing,
        tuple(
            (name, overall(fruit_rows(some, confidence), found_rows(some, confidence)))
            for name, some in parts.items()
        ),
        tuple(fruit_rows(frames, confidence)),
        tuple(found_rows(frames, confidence)),
    )
