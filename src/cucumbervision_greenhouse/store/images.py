"""Images beside the database, named by the hash of their content and written atomically."""

from __future__ import annotations

import hashlib
import os
import time
import uuid
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import cast

import numpy as np

from cucumbervision.arrays import Array32, Numbers, Pixels
from cucumbervision.errors import StoredImageError, StoreError, wrap_os_errors
from cucumbervision.files import replacing, sync_folder

DEPTH_UNIT_M = 0.0001  # 16 bits reach 6.5 m, beyond every valid reading; rounds by 0.05 mm
THUMBNAIL_PX = 320
_THUMBNAIL_QUALITY = 80
_ABANDONED_S = 3600.0  # age of a partial file that nobody writes any more


class ImageStore:
    """A folder of images.

    A file is written under a temporary name, flushed to the disk and then renamed, so that a power
    failure leaves a complete file or none. Existing files are never overwritten, and the content
    is compared with the name when it is read.

    Parameters
    ----------
    folder : Path
        Made when the first image is put.

    Examples
    --------
    >>> import tempfile
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     store = ImageStore(Path(folder))
    ...     name = store.put_depth(np.full((48, 64), 0.4545, np.float32))
    ...     store.path(name).relative_to(folder).parts[0] == name[:2]
    ...     round(float(store.read_depth(name)[0, 0]), 6)
    True
    0.4545
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def put_color(self, color: Pixels) -> str:
        """Store a colour image as PNG, from which can be measured again to the same length.

        Parameters
        ----------
        color : ndarray of uint8, shape (H, W, 3)
            RGB.

        Raises
        ------
        StoreError
            If the folder cannot be written.
        """
        return self._put_image(color, ".png")

    def put_thumbnail(self, color: Pixels) -> str:
        """Store a small JPEG of a colour image, at most `THUMBNAIL_PX` wide or high."""
        import cv2

        scale = min(1.0, THUMBNAIL_PX / max(color.shape[:2]))
        size = (max(1, round(color.shape[1] * scale)), max(1, round(color.shape[0] * scale)))
        small = cv2.resize(color, size, interpolation=cv2.INTER_AREA)
        quality = (cv2.IMWRITE_JPEG_QUALITY, _THUMBNAIL_QUALITY)
        return self._put_image(cast("Numbers", small), ".jpg", quality)

    def put_depth(self, depth_m: Array32) -> str:
        """Store a depth image as 16-bit PNG in steps of `DEPTH_UNIT_M`; 0 is no reading.

        Parameters
        ----------
        depth_m : ndarray of float32, shape (H, W)
            Metres; what is not finite or beyond 16 bits becomes 0, which is no reading either.
        """
        steps = np.rint(np.nan_to_num(depth_m, nan=0.0, posinf=0.0, neginf=0.0) / DEPTH_UNIT_M)
        stored_steps = np.where((steps > 0) & (steps <= np.iinfo(np.uint16).max), steps, 0)
        return self._put_image(stored_steps.astype(np.uint16), ".png")

    def put(self, data: bytes, suffix: str) -> str:
        """Store an encoded image, and return its name: the hash of its content, and its suffix.

        Raises
        ------
        StoreError
            If the folder cannot be written.
        """
        name = hashlib.sha256(data).hexdigest() + suffix
        path = self.path(name)
        remedy = "check the folder's permissions, then send the stop again"
        with wrap_os_errors("cannot be written", path, remedy, StoreError):
            if not self._has(path):
                self._write_whole(path, data)
        return name

    def path(self, name: str) -> Path:
        """Return an image's file: two levels of folders, then the whole hash."""
        return self.folder / name[:2] / name[2:4] / name

    def read(self, name: str) -> bytes:
        """Read an image's file and compare it with its hash.

        Raises
        ------
        StoredImageError
            If it is missing, or its content does not match its name.
        """
        path = self.path(name)
        remedy = "copy it back from a backup; its name is the hash of its content"
        with wrap_os_errors("cannot be read", path, remedy, StoredImageError):
            data = path.read_bytes()
        if hashlib.sha256(data).hexdigest() != path.stem:
            raise StoredImageError(
                "its content does not match its name", source=path, remedy=remedy
            )
        return data

    def read_color(self, name: str) -> Pixels:
        """Read a colour image or thumbnail: RGB, uint8, shape (H, W, 3)."""
        return cast("Pixels", self._decoded(name, "IMREAD_COLOR")[..., ::-1].copy())

    def read_depth(self, name: str, unit_m: float = DEPTH_UNIT_M) -> Array32:
        """Read a depth image: metres, float32, shape (H, W), 0 where there is no reading."""
        steps = self._decoded(name, "IMREAD_UNCHANGED")
        return (steps.astype(np.float64) * unit_m).astype(np.float32)

    def _decoded(self, name: str, how: str) -> Numbers:
        import cv2

        image = cv2.imdecode(np.frombuffer(self.read(name), np.uint8), getattr(cv2, how))
        if image is None:  # the hash is right, so it was no image when it was put
            raise StoredImageError("is not a readable picture", remedy="measure the capture again")
        return cast("Numbers", image)

    def files(self) -> Iterator[Path]:
        """Return every image in the folder, named by a hash or not."""
        yield from self.folder.glob("??/??/*")

    def clean(self) -> None:
        """Remove partial files of killed programs; new ones may be being written."""
        for path in self._half_written.glob("*"):
            with suppress(OSError):
                if time.time() - path.stat().st_mtime > _ABANDONED_S:
                    path.unlink()

    @property
    def _half_written(self) -> Path:
        return self.folder / "writing"

    def _put_image(self, image: Numbers, suffix: str, parameters: tuple[int, ...] = ()) -> str:
        import cv2

        if image.ndim == 3:
            image = cv2.cvtColor(image, cv2.COLOR_RGB2BGR)
        _, data = cv2.imencode(suffix, image, parameters)
        return self.put(data.tobytes(), suffix)

    def _has(self, path: Path) -> bool:
        """Return whether the image is there and whole; its time of change becomes now.

        The time of change is what keeps `check` from removing an image as an orphan between
        this and the transaction that names it.
        """
        try:
            os.utime(path)
            digest = hashlib.sha256(path.read_bytes()).hexdigest()
        except FileNotFoundError:
            return False
        if digest == path.stem:
            return True
        # Kept, so that what happened to it can be looked into.
        path.replace(path.with_name(f"{path.name}.damaged-{uuid.uuid4().hex[:8]}"))
        return False

    def _write_whole(self, path: Path, data: bytes) -> None:
        new_folders = [folder for folder in path.parents[:3] if not folder.exists()]
        path.parent.mkdir(parents=True, exist_ok=True)
        self._half_written.mkdir(exist_ok=True)
        with replacing(path, self._half_written) as part:
            part.write_bytes(data)
        for new in new_folders:
            sync_folder(new.parent)
