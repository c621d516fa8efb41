"""Recall and precision on audited real photos."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import cv2
import numpy as np

from cucumbervision.capture.pictures import read_color
from cucumbervision_lab.datasets.labels import ticked
from cucumbervision_lab.detection import photo_audit
from cucumbervision_lab.detection.outcomes import (
    DetectionRow,
    EndRow,
    FruitRow,
    GroupScore,
    detection_rows,
    end_rows,
    fruit_rows,
    overall,
)
from cucumbervision_lab.detection.picture_result import detect_picture
from cucumbervision_lab.detection.pictures import Frame, TrueFruit

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence
    from pathlib import Path

    from numpy.typing import NDArray

    from cucumbervision_lab.detection.picture_result import Networks

_GREY = 114  # letterbox padding

Scores = tuple[tuple[str, GroupScore], ...]


@dataclass(frozen=True)
class PhotoResult:
    """Results of the networks on real photos.

    Parameters
    ----------
    confidence : float
        Confidence threshold.
    photos, scenes, missing : int
        Number of evaluated photos, of their scenes, and of audited photos that are missing.
    scores : tuple of (str, GroupScore)
        Recall and precision of all photos, and by setting.
    fruit, detections : tuple
        Rows of all fruit and of all detections.
    tests : tuple of (str, GroupScore)
        Recall and precision by test: 'first audit', 'trial board', 'on the plant', ...
    small : tuple of (str, GroupScore)
        Recall and precision at half size, of all photos and by test.
    ends : tuple of EndRow
        Errors of the ends of detected fruit with labelled ends, in percent of the straight line
        between them.
    """

    confidence: float
    photos: int
    scenes: int
    missing: int
    scores: Scores
    fruit: tuple[FruitRow, ...]
    detections: tuple[DetectionRow, ...]
    tests: Scores = ()
    small: Scores = ()
    ends: tuple[EndRow, ...] = ()


@dataclass(frozen=True, eq=False)
class Photo:
    """An audited photo.

    Parameters
    ----------
    truth : Frame
        Labels.
    path : Path
        File of the photo.
    setting : str
        Background of the fruit: 'board', 'cart', 'plant' …
    test : str
        Name of its test.
    """

    truth: Frame
    path: Path
    setting: str
    test: str


def audited_photos(folder: Path, split: str = "test") -> tuple[list[Photo], int]:
    """Return the audited photos of a folder.

    Parameters
    ----------
    folder : Path
        Folder, searched recursively.
    split : str
        Split of the audit; no network was trained on 'test'.

    Returns
    -------
    photos : list of Photo
        The photos, with zucchini as optional fruit.
    missing : int
        Number of audited photos that are missing.

    Raises
    ------
    DataSetError
        If the folder contains no audited photo.
    """
    data = photo_audit.audited(folder, split)
    photos = []
    for picture in data.pictures:
        true_fruit = tuple(
            TrueFruit(
                label.box,
                keypoints=_keypoints(label.extras.get("ends_px")),
                ignore=label.ignore,
                optional=label.extras["kind"] == "zucchini",
                cut_off=label.cut_off,
            )
            for label in picture.labels
        )
        truth = Frame(picture.file, picture.scene, picture.width, picture.height, true_fruit)
        extras = picture.extras
        photos.append(Photo(truth, data.path(picture), extras["setting"], extras["test"]))
    return photos, len(photo_audit.load_audit().in_split(split)) - len(photos)


def _keypoints(ends_px: Sequence[Sequence[float]] | None) -> NDArray[np.float64] | None:
    """Return five keypoints of which only the two ends are labelled."""
    if ends_px is None:
        return None
    blossom, stem = np.asarray(ends_px, np.float64)
    line = np.linspace(blossom, stem, 5)
    return np.column_stack([line, [2.0, 0.0, 0.0, 0.0, 2.0]])


def evaluate_photos(
    photos: Sequence[Photo],
    networks: Networks,
    missing: int = 0,
    report: Callable[[int], None] | None = None,
) -> PhotoResult:
    """Run the networks on photos and compute recall and precision.

    Parameters
    ----------
    photos : sequence of Photo
        Photos from `audited_photos`.
    networks : Networks
        Networks to evaluate.
    missing : int
        Number of audited photos that are missing.
    report : callable, optional
        Called with 1 after each photo.

    Raises
    ------
    CaptureError
        If a photo cannot be read.
    """
    frames, small = [], []
    for photo in ticked(photos, report):
        color = read_color(photo.path)
        frames.append(detect_picture(photo.truth, color, networks).frame)
        truth, shrunk = half_size(photo.truth, color)
        small.append(detect_picture(truth, shrunk, networks).frame)
    tests = [photo.test for photo in photos]
    result = score_photos(frames, [photo.setting for photo in photos], networks.confidence, missing)
    return replace(
        result,
        tests=_by_name(frames, tests, networks.confidence),
        small=_by_name(small, ["all"] * len(small), networks.confidence)
        + _by_name(small, tests, networks.confidence),
    )


def half_size(truth: Frame, color: NDArray[np.uint8]) -> tuple[Frame, NDArray[np.uint8]]:
    """Return a photo at half size, centred in a grey picture of the original size.

    Without the padding, a network would scale the smaller picture up to its input size, so the
    fruit would only be blurred.

    Parameters
    ----------
    truth : Frame
        Labels of the photo.
    color : ndarray of uint8, shape (H, W, 3)
        The photo, RGB.

    Returns
    -------
    truth : Frame
        Labels with transformed boxes and without keypoints.
    color : ndarray of uint8, shape (H, W, 3)
        The padded picture.

    Examples
    --------
    >>> from cucumbervision_lab.detection.pictures import Frame, TrueFruit
    >>> frame = Frame("a.jpg", "s", 8, 4, (TrueFruit(np.array([-0.5, -0.5, 7.5, 3.5])),))
    >>> truth, color = half_size(frame, np.zeros((4, 8, 3), np.uint8))
    >>> truth.true[0].box.tolist()
    [1.5, 0.5, 5.5, 2.5]
    >>> color[:, :, 0].tolist()[1]
    [114, 114, 0, 0, 0, 0, 114, 114]
    """
    height, width = color.shape[:2]
    inner = cv2.resize(color, (width // 2, height // 2), interpolation=cv2.INTER_AREA)
    rows, columns = inner.shape[:2]
    top, margin = (height - rows) // 2, (width - columns) // 2
    out = np.full_like(color, _GREY)
    out[top : top + rows, margin : margin + columns] = inner
    gain = np.tile([columns / width, rows / height], 2)
    true_fruit = tuple(
        replace(
            fruit, box=(fruit.box + 0.5) * gain + np.tile([margin, top], 2) - 0.5, keypoints=None
        )
        for fruit in truth.true
    )
    return replace(truth, true=true_fruit), out


def score_photos(
    frames: Sequence[Frame], settings: Sequence[str], confidence: float, missing: int = 0
) -> PhotoResult:
    """Compute recall and precision on photos.

    Parameters
    ----------
    frames : sequence of Frame
        Labels and detections.
    settings : sequence of str
        Setting of each photo.
    confidence : float
        Confidence threshold.
    missing : int
        Number of audited photos that are missing.

    Examples
    --------
    >>> import numpy as np
    >>> from cucumbervision_lab.detection.pictures import Frame, DetectedFruit, TrueFruit
    >>> boxes = np.array([[0.0, 0, 50, 10], [0, 20, 50, 30], [0, 40, 50, 50]])
    >>> true_fruit = (TrueFruit(boxes[0]), TrueFruit(boxes[1], optional=True))
    >>> detections = tuple(DetectedFruit(box, 0.9) for box in boxes)
    >>> frame = Frame("a.jpg", "s1", 60, 60, true_fruit, kept=detections)
    >>> result = score_photos([frame], ["board"], 0.3)
    >>> result.scores[0][1].recall.value, result.scores[0][1].precision.value
    (1.0, 0.5)
    """
    return PhotoResult(
        confidence,
        len(frames),
        len({frame.scene for frame in frames}),
        missing,
        _by_name(frames, ["all"] * len(frames), confidence)
        + _by_name(frames, settings, confidence),
        tuple(fruit_rows(frames, confidence)),
        tuple(detection_rows(frames, confidence)),
        ends=tuple(end_rows(frames, confidence)),
    )


def _by_name(frames: Sequence[Frame], names: Sequence[str], confidence: float) -> Scores:
    parts: dict[str, list[Frame]] = {name: [] for name in sorted(set(names))}
    for frame, name in zip(frames, names, strict=True):
        parts[name].append(frame)
    return tuple(
        (name, overall(fruit_rows(frames, confidence), detection_rows(frames, confidence)))
        for name, frames in parts.items()
    )
