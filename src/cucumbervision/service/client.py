"""A client of the service for robots and scripts; needs no extra."""

from __future__ import annotations

import io
import json
import tempfile
import zipfile
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import urllib3

from cucumbervision.capture.frames import Capture
from cucumbervision.capture.readers import RECORDING_SUFFIXES, open_source
from cucumbervision.capture.readers.native import write_native
from cucumbervision.capture.source import safe_name
from cucumbervision.errors import CaptureError, CucumberVisionError, wrap_reader_errors


class ServiceError(CucumberVisionError):
    """The service cannot be reached, or rejects a request.

    `status` is the HTTP status; 0 without an answer.
    """

    status = 0


class Client:
    """Sends captures and images to a service, and returns the results.

    Parameters
    ----------
    url : str
        Address of the service, such as 'http://127.0.0.1:8600'.
    token : str
        The service's token, if it has one.
    timeout_s : float
        Timeout for an answer.
    """

    def __init__(self, url: str, token: str = "", timeout_s: float = 60.0) -> None:
        if not url.startswith(("http://", "https://")):
            raise ServiceError(
                "not an address of a service",
                source=url,
                remedy="give an address that begins with http",
            )
        self._url, self._token, self._timeout_s = url.rstrip("/"), token, timeout_s

    def __repr__(self) -> str:
        return f"<Client {self._url}>"

    def health(self) -> dict[str, Any]:
        """Return the service's status and version."""
        return self._ask("/health")

    def measure(self, *sources: Capture | Path) -> dict[str, Any]:
        """Measure captures, or files and folders of them; recordings are played on this machine.

        Returns
        -------
        dict
            `captures` with their `fruit`, each a row of the tables' columns; `failures`.

        Raises
        ------
        ServiceError
            If the service cannot be reached, or rejects the request.
        CaptureError
            If a file or folder cannot be read.
        """
        files: list[tuple[str, bytes]] = []
        for source in sources:
            if isinstance(source, Path) and (
                source.is_dir() or source.suffix.lower() in RECORDING_SUFFIXES
            ):
                files += [packed(ref.load()) for ref in open_source(source)]
            else:
                files.append(_file(source) if isinstance(source, Path) else packed(source))
        return self._ask("/measure", files)

    def detect(self, *pictures: Path) -> dict[str, Any]:
        """Find fruit in images.

        Returns
        -------
        dict
            `pictures` with their `fruit` as COCO's results; `failures`.

        Raises
        ------
        ServiceError
            As `measure`.
        CaptureError
            If a file cannot be read.
        """
        return self._ask("/detect", [_file(picture) for picture in pictures])

    def _ask(self, path: str, files: Iterable[tuple[str, bytes]] | None = None) -> dict[str, Any]:
        headers = {"Authorization": f"Bearer {self._token}"} if self._token else {}
        fields = None if files is None else [("files", file) for file in files]
        try:
            answer = urllib3.request(
                "GET" if files is None else "POST",
                self._url + path,
                fields=fields,
                headers=headers,
                timeout=self._timeout_s,
                retries=False,
            )
            reply: dict[str, Any] = json.loads(answer.data)
        except (urllib3.exceptions.HTTPError, ValueError) as error:
            raise ServiceError(
                f"does not answer ({error})", source=self._url, remedy="check that it runs"
            ) from None
        if answer.status >= 400:
            refused = ServiceError(str(reply.get("message", answer.reason)), source=self._url)
            refused.status = answer.status
            raise refused
        return reply


def packed(capture: Capture) -> tuple[str, bytes]:
    """Return a capture as a file to send: its zipped native folder.

    Examples
    --------
    >>> import numpy as np
    >>> from cucumbervision.capture.frames import Capture
    >>> from cucumbervision.capture.intrinsics import Intrinsics
    >>> depth_m = np.full((48, 64), 0.5, np.float32)
    >>> lens = Intrinsics(64, 48, 60.0, 60.0, 32.0, 24.0)
    >>> name, data = packed(Capture(np.zeros((48, 64, 3), np.uint8), depth_m, lens, "row 3"))
    >>> name, zipfile.ZipFile(io.BytesIO(data)).namelist()[0]
    ('row_3.zip', 'row_3/capture.json')
    """
    name, content = safe_name(capture.name), io.BytesIO()
    with tempfile.TemporaryDirectory(prefix="cucumbervision-") as folder:
        made = write_native(capture, Path(folder) / name).parent
        with zipfile.ZipFile(content, "w") as archive:
            for path in sorted(made.rglob("*")):
                if path.is_file():
                    archive.write(path, path.relative_to(folder))
    return f"{name}.zip", content.getvalue()


def _file(path: Path) -> tuple[str, bytes]:
    with wrap_reader_errors(path, CaptureError, "check the path"):
        return path.name, path.read_bytes()
