"""Pictures beside the database, named by the hash of their content and written atomically."""

from __future__ import annotations

import hashlib
import os
import time
import uuid
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from cucumbervision.errors import StoredImageError, StoreError, wrap_os_errors
from cucumbervision.files import replacing, sync_folder

DEPTH_UNIT_M = 0.0001  # 16 bits reach 6.5 m, beyond every valid reading; rounds by 0.05 mm
THUMBNAIL_PX = 320
_THUMBNAIL_QUALITY = 80
_ABANDONED_S = 3600.0  # age of a partial file that nobody writes any more


class ImageStore:
    """A folder of pictures.

    A file is written under a temporary name, flushed to the disk and then renamed, so that a power
    failure leaves a complete file or none. Existing files are never overwritten, and the content
    is compared with the name when it is read.

    Parameters
    ----------
    folder : Path
        Made when the first picture is put.

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

    def put_color(self, color: NDArray[np.uint8]) -> str:
        """Store a colour picture as PNG, from which can be measured again to the same length.

        Parameters
        ----------
        color : ndarray of uint8, shape (H, W, 3)
            RGB.

        Raises
        ------
        StoreError
            If the folder cannot be written.
        """
        return self._put_picture(color, ".png")

    def put_thumbnail(self, color: NDArray[np.uint8]) -> str:
        """Store a small JPEG of a colour picture, at most `THUMBNAIL_PX` wide or high."""
        import cv2

        scale = min(1.0, THUMBNAIL_PX / max(color.shape[:2]))
        size = (max(1, round(color.shape[1] * scale)), max(1, round(color.shape[0] * scale)))
        small = cv2.resize(color, size, interpolation=cv2.INTER_AREA)
        quality = (cv2.IMWRITE_JPEG_QUALITY, _THUMBNAIL_QUALITY)
        return self._put_picture(cast("NDArray[Any]", small), ".jpg", quality)

    def put_depth(self, depth_m: NDArray[np.float32]) -> str:
        """Store a depth picture as 16-bit PNG in steps of `DEPTH_UNIT_M`; 0 is no reading.

        Parameters
        ----------
        depth_m : ndarray of float32, shape (H, W)
            Metres; what is not finite or beyond 16 bits becomes 0, which is no reading either.
        """
        steps = np.rint(np.nan_to_num(depth_m, nan=0.0, posinf=0.0, neginf=0.0) / DEPTH_UNIT_M)
        stored_steps = np.where((steps > 0) & (steps <= np.iinfo(np.uint16).max), steps, 0)
        return self._put_picture(stored_steps.astype(np.uint16), ".png")

    def put(self, data: bytes, suffix: str) -> str:
        """Store an encoded picture, and return its name: the hash of its content, and its suffix.

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
        """Return a picture's file: two levels of folders, then the whole hash."""
        return self.folder / name[:2] / name[2:4] / name

    def read(self, name: str) -> bytes:
        """Read a picture's file and compare it with its hash.

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

    def read_color(self, name: str) -> NDArray[np.uint8]:
        """Read a colour picture or thumbnail: RGB, uint8, shape (H, W, 3)."""
        import cv2

        image = cv2.imdecode(np.frombuffer(self.read(name), np.uint8), cv2.IMREAD_COLOR)
        return cast("NDArray[np.uint8]", cv2.cvtColor(_decoded(image), cv2.COLOR_BGR2RGB))

    def read_depth(self, name: str, unit_m: float = DEPTH_UNIT_M) -> NDArray[np.float32]:
        """Read a depth picture: metres, float32, shape (H, W), 0 where there is no reading."""
        import cv2

        image = cv2.imdecode(np.frombuffer(self.read(name), np.uint8), cv2.IMREAD_UNCHANGED)
        return (_decoded(image).astype(np.float64) * unit_m).astype(np.float32)

    def files(self) -> Iterator[Path]:
        """Return every picture in the folder, named by a hash or not."""
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

    def _put_picture(
        self, image: NDArray[Any], suffix: str, parameters: tuple[int, ...] = ()
    ) -> str:
        import cv2

        if image.ndim == 3:
            image = cv2.cvtColor(image, cv2.COLOR_RGB2BGR)
        _, data = cv2.imencode(suffix, image, parameters)
        return self.put(data.tobytes(), suffix)

    def _has(self, path: Path) -> bool:
        """Return whether the picture is there and whole; its time of change becomes now.

        The time of change is what keeps `check` from removing a picture as an orphan between
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


def _decoded(image: Any) -> NDArray[Any]:
    if image is None:  # the hash is right, so it was no picture when it was put
        raise StoredImageError("is not a readable picture", remedy="measure the capture again")
    return cast("NDArray[Any]", image)
