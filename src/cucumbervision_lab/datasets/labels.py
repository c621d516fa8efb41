"""What a labelled picture says, and a set of them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from cucumbervision.perception.instances import KEYPOINT_NAMES, SKELETON
from cucumbervision.perception.masks import Rle

if TYPE_CHECKING:
    from numpy.typing import ArrayLike, NDArray

    from cucumbervision.capture.intrinsics import Intrinsics
    from cucumbervision.errors import CucumberVisionError

__all__ = ["SPLITS", "DataSet", "Label", "LabelledPicture"]

SPLITS = ("train", "val", "test")


@dataclass(frozen=True, eq=False)
class Label:
    """One fruit as somebody labelled it.

    Parameters
    ----------
    box : ndarray of float64, shape (4,)
        x1, y1, x2, y2 of the box's edges in pixels; (0, 0) is the centre of the top-left pixel,
        so a box over the whole picture runs from -0.5 to W - 0.5.
    category : int
        Index into `DataSet.categories`.
    mask_code : Rle, optional
        The visible pixels; `mask` decodes it.
    amodal_code : Rle, optional
        The pixels that would be visible if nothing hid the fruit; `amodal` decodes it.
    keypoints : ndarray of float64, shape (5, 3), optional
        u, v in pixels and visibility 0 (not labelled or outside), 1 (hidden), 2 (seen) of KP0
        (blossom end) to KP4 (stem end).
    hidden_share : float, optional
        Share of the amodal pixels that something hides, 0 to 1, where it is known.
    cut_off : bool
        Whether the fruit runs on beyond the picture.
    ignore : bool
        Neither fruit nor background: a slice, a crate boxed only in part.
    pseudo : bool
        Whether a network drew the mask, which therefore is no truth.
    extras : mapping of str to JSON values
        What else is known: centreline_m, thread_m, chord_m, distance_m, tilt_deg, axis_m,
        radius_m.

    Examples
    --------
    >>> mask = np.zeros((4, 6), bool)
    >>> mask[1, 2:5] = True
    >>> label = Label.of_mask(mask)
    >>> label.box.tolist(), label.mask.sum(), label.amodal is None
    ([1.5, 0.5, 4.5, 1.5], np.int64(3), True)
    """

    box: NDArray[np.float64]
    category: int = 0
    mask_code: Rle | None = None
    amodal_code: Rle | None = None
    keypoints: NDArray[np.float64] | None = None
    hidden_share: float | None = None
    cut_off: bool = False
    ignore: bool = False
    pseudo: bool = False
    extras: Mapping[str, Any] = field(default_factory=dict)

    @classmethod
    def of_mask(
        cls,
        mask: NDArray[np.bool_],
        *,
        box: ArrayLike | None = None,
        amodal: NDArray[np.bool_] | None = None,
        **rest: Any,
    ) -> Label:
        """Make a label from masks of shape (H, W); the box is the visible mask's if none is given.

        Parameters
        ----------
        mask : ndarray of bool, shape (H, W)
            The visible pixels, at least one.
        box : array_like, shape (4,), optional
            x1, y1, x2, y2 in pixels.
        amodal : ndarray of bool, shape (H, W), optional
            The whole outline.
        **rest
            The other fields.

        Raises
        ------
        ValueError
            If the mask is empty and no box is given.
        """
        from cucumbervision.perception.masks import box_of_mask

        edges = box_of_mask(mask) if box is None else np.asarray(box, np.float64)
        code = Rle.of(mask) if mask.any() else None
        return cls(
            edges, mask_code=code, amodal_code=amodal if amodal is None else Rle.of(amodal), **rest
        )

    @property
    def mask(self) -> NDArray[np.bool_] | None:
        """The visible pixels, bool, shape (H, W); decoded anew at each call."""
        return None if self.mask_code is None else self.mask_code.decode()

    @property
    def amodal(self) -> NDArray[np.bool_] | None:
        """The whole outline, bool, shape (H, W); decoded anew at each call."""
        return None if self.amodal_code is None else self.amodal_code.decode()


@dataclass(frozen=True, eq=False)
class LabelledPicture:
    """A picture and its labels.

    Parameters
    ----------
    file : str
        Relative to the set's folder, with '/': 'images/000001.jpg'.
    width, height : int
        In pixels.
    labels : tuple of Label
        None of them: a picture of background only.
    scene : str
        What the picture shares with its near-duplicates; pictures of one scene stay in one split.
    split : str
        'train', 'val', 'test', or '' while it is in none.
    source : str
        Whose picture it is: 'synth', a publisher's set.
    licence : str
        As the source states it.
    depth_file : str, optional
        Relative to the set's folder: 16-bit PNG, 0 = no reading.
    depth_unit_m : float
        Metres of one step of `depth_file`.
    camera : Intrinsics, optional
        The colour camera's, to which depth is aligned.
    extras : mapping of str to JSON values
        What else is known of the picture.
    """

    file: str
    width: int
    height: int
    labels: tuple[Label, ...] = ()
    scene: str = ""
    split: str = ""
    source: str = ""
    licence: str = ""
    depth_file: str | None = None
    depth_unit_m: float = 0.001
    camera: Intrinsics | None = None
    extras: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class DataSet:
    """Labelled pictures in one folder.

    Parameters
    ----------
    folder : Path
        Where the pictures' file names start.
    pictures : tuple of LabelledPicture
        In the order of the files.
    categories : tuple of str
        Names of the classes that `Label.category` counts.
    keypoint_names : tuple of str
        Of the five keypoints.
    skeleton : tuple of (int, int)
        Which keypoints a line joins.
    flip_index : tuple of int
        Which keypoint each becomes in a mirrored picture: itself, a fruit has no left and right.
    refused : tuple of CucumberVisionError
        What a reader found and could not use; the rest is in `pictures`.
    """

    folder: Path
    pictures: tuple[LabelledPicture, ...]
    categories: tuple[str, ...] = ("cucumber",)
    keypoint_names: tuple[str, ...] = KEYPOINT_NAMES
    skeleton: tuple[tuple[int, int], ...] = SKELETON
    flip_index: tuple[int, ...] = (0, 1, 2, 3, 4)
    refused: tuple[CucumberVisionError, ...] = ()

    def path(self, picture: LabelledPicture) -> Path:
        """Give the file of a picture."""
        return self.folder / picture.file

    def in_split(self, split: str) -> tuple[LabelledPicture, ...]:
        """Give the pictures of one split.

        Examples
        --------
        >>> picture = LabelledPicture("images/a.png", 64, 48, split="val")
        >>> data = DataSet(Path("set"), (picture,))
        >>> len(data.in_split("val")), len(data.in_split("train"))
        (1, 0)
        """
        return tuple(p for p in self.pictures if p.split == split)
