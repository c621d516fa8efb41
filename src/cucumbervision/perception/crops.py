"""Classify the crop around each detection, which may lower its confidence.

The detector sees a whole picture at once and takes some stalks, leaves and other fruit for
cucumbers. A classifier trained on its mistakes, on the crop around a single box, knows many of
them. Its output is the evidence of the crop alone, to be added to the detector's log-odds; it
never raises a confidence: canopies give few detections to learn from, and there a raised
confidence made false positives.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import cv2
import numpy as np
from scipy.special import expit, logit

from cucumbervision.perception.classifier import PictureClassifier

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from cucumbervision.instances.instance import Instance

CROP_PX = 96
"""Height and width of the network's input."""

CROP_MARGIN = 1.35
"""Side of a crop, in longest sides of the box."""

_WEIGHT = 0.7  # of the network's log-odds beside the detector's: both saw the same pictures
_GREY = 114  # the padding of network inputs


def crop_square(
    color_rgb: NDArray[np.uint8],
    box: NDArray[np.float64],
    side_px: int = CROP_PX,
    margin: float = CROP_MARGIN,
) -> NDArray[np.uint8]:
    """Return the square around a box, resized.

    Parameters
    ----------
    color_rgb : ndarray of uint8, shape (H, W, 3)
        The picture.
    box : ndarray of float64, shape (4,)
        x1, y1, x2, y2 of the edges in pixels; (0, 0) is the centre of the top-left pixel.
    side_px : int
        Side of the result.
    margin : float
        Side of the square, in longest sides of the box.

    Returns
    -------
    ndarray of uint8, shape (side_px, side_px, 3)
        Grey (114) outside the picture.

    Examples
    --------
    >>> picture = np.full((60, 80, 3), 200, np.uint8)
    >>> crop = crop_square(picture, np.array([-0.5, 9.5, 39.5, 49.5]), side_px=8, margin=2)
    >>> crop[4, :, 0].tolist()
    [114, 114, 200, 200, 200, 200, 200, 200]
    """
    corner, opposite = box[:2], box[2:]
    side = max(int(np.ceil(margin * max((opposite - corner).max(), 1.0))), 2)
    left_px, top = np.rint((corner + opposite + 1 - side) / 2).astype(int)
    height, width = color_rgb.shape[:2]
    x1, y1, x2, y2 = (
        max(left_px, 0),
        max(top, 0),
        min(left_px + side, width),
        min(top + side, height),
    )
    square = np.full((side, side, 3), _GREY, np.uint8)
    square[y1 - top : y2 - top, x1 - left_px : x2 - left_px] = color_rgb[y1:y2, x1:x2]
    shrinks = side > side_px
    resized = cv2.resize(
        square, (side_px, side_px), interpolation=cv2.INTER_AREA if shrinks else cv2.INTER_LINEAR
    )
    return np.asarray(resized, np.uint8)


def lowered(confidence: float, log_odds: float) -> float:
    """Return a detection's confidence after the classification of its crop.

    Parameters
    ----------
    confidence : float
        Confidence of the detector, 0 to 1.
    log_odds : float
        Log-odds of the network for a cucumber; positive values change nothing.

    Examples
    --------
    >>> lowered(0.5, 3.0), round(lowered(0.5, -2.0), 3)
    (0.5, 0.198)
    """
    if log_odds >= 0:
        return confidence
    return float(expit(logit(np.clip(confidence, 1e-6, 1 - 1e-6)) + _WEIGHT * log_odds))


class CropClassifier(PictureClassifier):
    """Classifies crops as cucumbers or false detections.

    Parameters and errors are those of `SmallNetwork`.
    """

    shapes = ((3, CROP_PX, CROP_PX),)
    takes = f"crops of {CROP_PX} px"
    command = "train classifier crops"

    def rescore(
        self, color_rgb: NDArray[np.uint8], instances: Sequence[Instance]
    ) -> tuple[Instance, ...]:
        """Lower the confidence of detections that do not look like a cucumber.

        Parameters
        ----------
        color_rgb : ndarray of uint8, shape (H, W, 3)
            The picture.
        instances : sequence of Instance
            The detections.

        Returns
        -------
        tuple of Instance
            Best first.
        """
        odds = self.log_odds(color_rgb, [instance.box for instance in instances])
        rescored = (
            replace(instance, confidence=lowered(instance.confidence, value))
            for instance, value in zip(instances, odds.tolist(), strict=True)
        )
        return tuple(sorted(rescored, key=lambda instance: -instance.confidence))

    def log_odds(
        self, color_rgb: NDArray[np.uint8], boxes: Sequence[NDArray[np.float64]]
    ) -> NDArray[np.float64]:
        """Return the log-odds that boxes hold a cucumber.

        Parameters
        ----------
        color_rgb : ndarray of uint8, shape (H, W, 3)
            The picture.
        boxes : sequence of ndarray of float64, shape (4,)
            x1, y1, x2, y2 of the edges, pixels.

        Returns
        -------
        ndarray of float64, shape (N,)
            Mean of the crop and its mirror image.
        """
        if not boxes:
            return np.zeros(0)
        crops = np.stack([crop_square(color_rgb, box) for box in boxes])
        return self.mean_logits(crops, crops[:, :, ::-1])
