"""SAM 2 (Ravi et al. 2024): its image predictor as a segmenter, with the user's own checkpoint."""

from __future__ import annotations

import hashlib
import re
from typing import TYPE_CHECKING

import numpy as np

from cucumbervision.errors import MissingExtraError, ModelError, wrap_reader_errors
from cucumbervision.instances.masks import mask_ious
from cucumbervision.perception.sam import Sam, accepted, clip_box, without_mask

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence
    from pathlib import Path

    from numpy.typing import NDArray

    from cucumbervision.instances.instance import Instance

_NAME = re.compile(r"(sam2(?:\.1)?)_hiera_(tiny|small|base_plus|large)")
_SIZES = {"tiny": "t", "small": "s", "base_plus": "b+", "large": "l"}


class Sam2(Sam):
    """The segmenter of a checkpoint of SAM 2 or 2.1, as `--segmenter FILE.pt` names it.

    Masks are chosen and rejected as those of `Sam`.

    Parameters
    ----------
    files : mapping of str to Path
        The file 'checkpoint', under its published name, such as 'sam2.1_hiera_tiny.pt'.
    runtime, full_precision, verified
        Ignored; for the same interface as other segmenters. PyTorch uses float32, and a GPU if
        there is one.
    prompt : str
        As in `Sam`.

    Raises
    ------
    MissingExtraError
        If PyTorch or sam2 is not installed.
    ModelError
        If the checkpoint is not one of SAM 2.
    """

    def __init__(
        self,
        files: Mapping[str, Path],
        runtime: str = "auto",  # noqa: ARG002
        prompt: str = "box+point",
        *,
        full_precision: bool = False,  # noqa: ARG002
        verified: bool = False,  # noqa: ARG002
    ) -> None:
        try:
            import torch
            from sam2.build_sam import build_sam2
            from sam2.sam2_image_predictor import SAM2ImagePredictor
        except ModuleNotFoundError:
            raise MissingExtraError("sam2", "sam2") from None
        path = files["checkpoint"]
        remedy = "name a published checkpoint, such as sam2.1_hiera_tiny.pt"
        named = _NAME.match(path.name)
        if named is None:
            raise ModelError("its name says no size of SAM 2", source=path, remedy=remedy)
        version, size = named.groups()
        config = f"configs/{version}/{version}_hiera_{_SIZES[size]}.yaml"
        device = "cuda" if torch.cuda.is_available() else "cpu"
        self.prompt = prompt
        with wrap_reader_errors(path, ModelError, remedy):
            self._predictor = SAM2ImagePredictor(build_sam2(config, str(path), device=device))
        self._runtime, self._picture = f"torch-{device}-float32", b""

    @property
    def runtime(self) -> str:
        """The runtime."""
        return self._runtime

    def mask_at(self, color_rgb: NDArray[np.uint8], u_px: float, v_px: float) -> NDArray[np.bool_]:
        """Draw the mask of the object at one pixel, as `Sam.mask_at`."""
        self._show(color_rgb)
        masks, sure = self._masks(np.array([u_px, v_px, u_px, v_px]), "point")
        return np.asarray(masks[int(sure.argmax())])

    def _drawn(
        self, color_rgb: NDArray[np.uint8], instances: Sequence[Instance]
    ) -> tuple[Instance, ...]:
        height, width = color_rgb.shape[:2]
        drawn = []
        for instance in instances:
            box = clip_box(instance.box, height, width)
            if box is None:
                drawn.append(without_mask(instance, "mask-empty"))
                continue
            self._show(color_rgb)
            masks, sure = self._masks(box, self.prompt)
            detector_mask = instance.detector_mask
            agreement = (
                mask_ious(masks, detector_mask)
                if detector_mask is not None and detector_mask.any()
                else 0.0
            )
            drawn.append(accepted(instance, masks[int((sure + agreement).argmax())], box))
        return tuple(drawn)

    def _show(self, color_rgb: NDArray[np.uint8]) -> None:
        """Encode a picture, unless it is the last one."""
        digest = hashlib.blake2b(np.ascontiguousarray(color_rgb).data).digest()
        if digest != self._picture:
            self._predictor.set_image(color_rgb)
            self._picture = digest

    def _masks(
        self, box: NDArray[np.float64], prompt: str
    ) -> tuple[NDArray[np.bool_], NDArray[np.float64]]:
        """Return masks of the picture's size and their predicted IoUs."""
        corners = np.asarray(box, np.float64) + 0.5  # SAM 2 measures from the picture's corner
        middle = corners.reshape(2, 2).mean(axis=0, keepdims=True)
        masks, sure, _ = self._predictor.predict(
            point_coords=None if prompt == "box" else middle,
            point_labels=None if prompt == "box" else np.ones(1, int),
            box=None if prompt == "point" else corners,
        )
        return masks > 0, np.asarray(sure, np.float64)
