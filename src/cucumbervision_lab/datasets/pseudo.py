"""Masks by SAM for fruit that people only drew boxes around; marked as what they are."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Protocol

from cucumbervision.capture.files import read_color
from cucumbervision.errors import DataSetError
from cucumbervision.perception.instances import Instance
from cucumbervision.perception.masks import Rle

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    import numpy as np
    from numpy.typing import NDArray

    from cucumbervision_lab.datasets.labels import DataSet, Label, LabelledPicture

__all__ = ["Drawn", "MaskSource", "add_pseudo_masks"]


class MaskSource(Protocol):
    """What draws masks: `cucumbervision.perception.sam.Segmenter`."""

    def segment(
        self, color_rgb: NDArray[np.uint8], instances: Sequence[Instance]
    ) -> tuple[Instance, ...]:
        """Give each instance with its mask, or without and why."""
        ...


@dataclass(frozen=True, eq=False)
class Drawn:
    """What `add_pseudo_masks` did.

    Parameters
    ----------
    dataset : DataSet
        The set with the masks.
    drawn : int
        Masks that were drawn.
    refused : tuple of (str, str)
        File and reason ('mask-off-box', ...) of each fruit that SAM's mask did not fit; it keeps
        its box, and is to be ignored.
    """

    dataset: DataSet
    drawn: int
    refused: tuple[tuple[str, str], ...]


def add_pseudo_masks(
    dataset: DataSet,
    segmenter: MaskSource,
    *,
    splits: Sequence[str] = ("train", "val", ""),
    progress: Callable[[int], None] | None = None,
) -> Drawn:
    """Draw a mask for every fruit that has only a box.

    Parameters
    ----------
    dataset : DataSet
        Fruit with masks and labels to ignore stay as they are.
    segmenter : MaskSource
        A `Segmenter`, prompted with box and centre.
    splits : sequence of str
        Whose pictures get masks; never 'test', which stays as people labelled it.
    progress : callable, optional
        Called with 1 after each picture.

    Returns
    -------
    Drawn

    Raises
    ------
    DataSetError
        If 'test' is asked for.
    CaptureError
        If a picture cannot be read.
    """
    if "test" in splits:
        raise DataSetError(
            "masks that a network drew are no truth to test on",
            source=dataset.folder,
            remedy="leave test out",
        )
    pictures: list[LabelledPicture] = []
    refused: list[tuple[str, str]] = []
    drawn = 0
    for picture in dataset.pictures:
        if picture.split in splits:
            labels, faults = _draw(dataset, picture, segmenter)
            drawn += sum(label.pseudo for label in labels) - sum(x.pseudo for x in picture.labels)
            refused += [(picture.file, fault) for fault in faults]
            picture = replace(picture, labels=labels)
        pictures.append(picture)
        if progress is not None:
            progress(1)
    return Drawn(replace(dataset, pictures=tuple(pictures)), drawn, tuple(refused))


def _draw(
    dataset: DataSet, picture: LabelledPicture, segmenter: MaskSource
) -> tuple[tuple[Label, ...], list[str]]:
    wanted = [k for k, x in enumerate(picture.labels) if x.mask_code is None and not x.ignore]
    if not wanted:
        return picture.labels, []
    color = read_color(dataset.path(picture))
    boxes = [Instance(picture.labels[k].box) for k in wanted]
    labels, faults = list(picture.labels), []
    for k, found in zip(wanted, segmenter.segment(color, boxes), strict=True):
        if found.mask is None:
            faults.append(found.mask_failure)
            labels[k] = replace(labels[k], ignore=True)
        else:
            labels[k] = replace(labels[k], mask_code=Rle.of(found.mask), pseudo=True)
    return tuple(labels), faults
