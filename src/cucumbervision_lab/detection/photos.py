"""Recall and precision on audited real photos."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import cv2
import numpy as np

from cucumbervision.capture.pictures import read_color
from cucumbervision_lab.datasets.labels import ticked
from cucumbervision_lab.detection import photo_audit
from cucumbervision_lab.detection.outcomes import Score, detection_rows, fruit_rows, overall
from cucumbervision_lab.detection.picture_result import detect_picture
from cucumbervision_lab.detection.pictures import Frame, TrueFruit

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence
    from pathlib import Path

    from numpy.typing import NDArray

    from cucumbervision_lab.detection.picture_result import Networks

_GREY = 114  # letterbox padding


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


@dataclass(frozen=True, eq=False)
class PhotoResult:
    """Results of the networks on real photos.

    Parameters
    ----------
    confidence : float
        Confidence threshold.
    photos : tuple of Photo
        The evaluated photos.
    frames, small : tuple of Frame
        Labels and detections of each photo, at full and at half size.
    missing : int
        Number of audited photos that are missing.
    """

    confidence: float
    photos: tuple[Photo, ...]
    frames: tuple[Frame, ...]
    small: tuple[Frame, ...] = ()
    missing: int = 0

    def score(self, *, small: bool = False, setting: str = "", test: str = "") -> Score:
        """Compute recall and precision, of all photos or those of a setting or a test."""
        pairs = zip(self.photos, self.small if small else self.frames, strict=True)
        frames = [
            frame
            for photo, frame in pairs
            if setting in ("", photo.setting) and test in ("", photo.test)
        ]
        threshold = self.confidence
        return overall(fruit_rows(frames, threshold), detection_rows(frames, threshold))


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
    count = sum(photo["split"] == split for photo in photo_audit.load_audit().values())
    return photos, count - len(photos)


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
    confidence = networks.confidence
    return PhotoResult(confidence, tuple(photos), tuple(frames), tuple(small), missing)


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
