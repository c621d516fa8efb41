"""A client of the service for robots and scripts; needs no extra."""

from __future__ import annotations

import contextlib
import http.client
import io
import json
import re
import secrets
import tempfile
import urllib.error
import urllib.request
import zipfile
from pathlib import Path
from typing import TYPE_CHECKING, Any

from cucumbervision.capture.readers import RECORDING_SUFFIXES, open_source
from cucumbervision.capture.readers.native import write_native
from cucumbervision.capture.source import safe_name
from cucumbervision.errors import CaptureError, CucumberVisionError, wrap_reader_errors

if TYPE_CHECKING:
    from collections.abc import Iterable

    from cucumbervision.capture.frames import Capture


class ServiceError(CucumberVisionError):
    """The service cannot be reached, or rejects a request.

    `status` is the HTTP status; 0 without an answer.
    """

    status = 0


class Client:
    """Sends captures and pictures to a service, and returns the results.

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
            if isinstance(source, Path) and _is_opened_here(source):
                files += [packed(ref.load()) for ref in open_source(source)]
            else:
                files.append(_file(source) if isinstance(source, Path) else packed(source))
        return self._ask("/measure", files)

    def detect(self, *pictures: Path) -> dict[str, Any]:
        """Find fruit in pictures.

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
        request = urllib.request.Request(self._url + path)
        if self._token:
            request.add_header("Authorization", f"Bearer {self._token}")
        if files is not None:
            kind, request.data = _form(files)
            request.add_header("Content-Type", kind)
        try:
            with _OPENER.open(request, timeout=self._timeout_s) as answer:
                reply: dict[str, Any] = json.load(answer)
                return reply
        except urllib.error.HTTPError as error:
            with error:
                raise self._refused(error.code, error.read()) from None
        except (OSError, ValueError) as error:
            reason = getattr(error, "reason", error)
            raise ServiceError(
                f"does not answer ({reason})", source=self._url, remedy="check that it runs"
            ) from None

    def _refused(self, status: int, body: bytes) -> ServiceError:
        try:
            message = str(json.loads(body)["message"])
        except (ValueError, KeyError, TypeError):
            message = f"refuses the request (HTTP {status})"
        refused = ServiceError(message, source=self._url)
        refused.status = status
        return refused


class _Refusable:
    """A connection that the server may close with an answer while the body is being sent."""

    def send(self, data: Any) -> None:
        # The answer sent before closing can still be read, and has the reason.
        with contextlib.suppress(BrokenPipeError, ConnectionResetError):
            super().send(data)  # type: ignore[misc]


class _Connection(_Refusable, http.client.HTTPConnection):
    pass


class _SecureConnection(_Refusable, http.client.HTTPSConnection):
    pass


class _Handler(urllib.request.HTTPHandler, urllib.request.HTTPSHandler):
    def http_open(self, request: urllib.request.Request) -> http.client.HTTPResponse:
        return self.do_open(_Connection, request)

    def https_open(self, request: urllib.request.Request) -> http.client.HTTPResponse:
        return self.do_open(_SecureConnection, request)


_OPENER = urllib.request.build_opener(_Handler)


def _is_opened_here(path: Path) -> bool:
    """Return whether a path goes capture by capture: a folder, or a recording."""
    return path.is_dir() or path.suffix.lower() in RECORDING_SUFFIXES


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


def _form(files: Iterable[tuple[str, bytes]]) -> tuple[str, bytes]:
    """Return a body of multipart/form-data (RFC 7578) and its type."""
    border, body = secrets.token_hex(16), io.BytesIO()
    for name, data in files:
        quoted = re.sub(r'[\r\n"\\]', "_", name)
        head = f'Content-Disposition: form-data; name="files"; filename="{quoted}"'
        kind = "Content-Type: application/octet-stream"
        body.write(f"--{border}\r\n{head}\r\n{kind}\r\n\r\n".encode() + data + b"\r\n")
    body.write(f"--{border}--\r\n".encode())
    return f"multipart/form-data; boundary={border}", body.getvalue()
