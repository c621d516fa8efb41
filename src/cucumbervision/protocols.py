"""What plugs in: detectors, segmenters, methods, readers and traits.

The package's own satisfy the same protocols, and are found by the same table (`plugins`).
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Protocol

if TYPE_CHECKING:
    from collections.abc import Sequence

    import numpy as np
    from numpy.typing import NDArray

    from cucumbervision.capture.frames import Capture
    from cucumbervision.capture.source import CaptureLister, Folder
    from cucumbervision.fruit.instance import Instance
    from cucumbervision.methods.result import Fruit, LengthKind, Measurement
    from cucumbervision.methods.table import Region
    from cucumbervision.methods.traits import TraitValue


class Detector(Protocol):
    """Finds the fruit of a capture: a function, or an object that can be called."""

    def __call__(self, capture: Capture, /) -> Sequence[Instance]:
        """Return the fruit of a capture.

        Parameters
        ----------
        capture : Capture
            `color` is uint8, shape (H, W, 3), red first; `depth_m` float32, shape (H, W), metres,
            0 where nothing was read.

        Returns
        -------
        sequence of Instance
            Each with its box: edges x1, y1, x2, y2 in pixels, where pixel (0, 0) is the centre of
            the upper left one. Masks are bool, shape (H, W); an instance without one is segmented.
        """
        ...


class Segmenter(Protocol):
    """Draws the masks of fruit.

    One that people may also point with has a method `mask_at(color_rgb, u_px, v_px)`, which
    returns the mask of the object at a pixel, bool, shape (H, W).
    """

    def segment(
        self, color_rgb: NDArray[np.uint8], instances: Sequence[Instance], /
    ) -> Sequence[Instance]:
        """Return the instances with masks, in the same order.

        Parameters
        ----------
        color_rgb : ndarray of uint8, shape (H, W, 3)
            The picture, red first.
        instances : sequence of Instance
            The fruit, by their boxes.

        Returns
        -------
        sequence of Instance
            With `mask`, bool, shape (H, W); or with None and the reason as `mask_failure`.
        """
        ...


class Method(Protocol):
    """Measures the length of a fruit.

    `measurement.methods.TableMethod` is one, and holds what else the table of methods says: what
    the method needs, and whether the selector may choose it. By default it never does: the method
    gets its column, and the length stays as it was.
    """

    @property
    def name(self) -> str:
        """The name, 'M7': the column is called after it, m7_cm."""
        ...

    @property
    def title(self) -> str:
        """What it is, in a few words."""
        ...

    @property
    def kind(self) -> LengthKind:
        """What its length is the length of."""
        ...

    def measure(self, region: Region, /) -> Measurement:
        """Return the length of a fruit in metres, or the reason why there is none.

        Parameters
        ----------
        region : Region
            The fruit's part of the frame: depth in metres, box, mask, keypoints, clouds.
        """
        ...


class Reader(Protocol):
    """Finds captures of one format in a folder."""

    def __call__(self, folder: Folder, /) -> CaptureLister | None:
        """Take the format's files out of a folder, and return what opens them.

        Parameters
        ----------
        folder : Folder
            Names of the files that no reader has taken yet; `take` removes those of this format.

        Returns
        -------
        callable or None
            Called with `ReadOptions` and the given intrinsics; returns for each capture its name,
            number, loader, place and files. None where the folder holds none of the format.
        """
        ...


class Trait(Protocol):
    """A figure of a fruit beside its length: a function of capture and fruit.

    The name is that of the column, and ends with the unit where there is one: 'firmness_mm'.
    """

    @property
    def name(self) -> str:
        """The column."""
        ...

    @property
    def unit(self) -> str:
        """Of the column: cm, mm, mm2, ml, g; any other, or none, is written as it is."""
        ...

    @property
    def says(self) -> str:
        """What it is, in a few words."""
        ...

    def __call__(self, capture: Capture, fruit: Fruit, /) -> float | TraitValue | None:
        """Return the value in SI units; None or a `TraitValue` with the reason where there is none.

        Parameters
        ----------
        capture : Capture
            The frame.
        fruit : Fruit
            The fruit with its mask, fit and length.
        """
        ...
