"""The HTTP service: limits, routes, metrics and start; requests are measured one at a time."""

from __future__ import annotations

import hmac
import tempfile
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import chain
from pathlib import Path
from typing import Annotated, Any, BinaryIO, Literal, TypeVar

import anyio.from_thread
import prometheus_client
from fastapi import FastAPI, File, Request, Response, UploadFile
from fastapi.exceptions import RequestValidationError
from fastapi.responses import JSONResponse, PlainTextResponse
from pydantic import BaseModel, Field
from starlette.datastructures import Headers
from starlette.exceptions import HTTPException

from cucumbervision import errors
from cucumbervision._version import __version__
from cucumbervision.about import software
from cucumbervision.capture.frames import Capture
from cucumbervision.capture.source import CaptureRef
from cucumbervision.capture.uploads import Limits, accept_uploads, clean_name, require_few
from cucumbervision.methods.result import FruitPose
from cucumbervision.run.batch import ResultWorker, list_source, never, results_of
from cucumbervision.run.detect import DetectedPicture, PictureWorker, read_picture
from cucumbervision.run.fields import FIELDS, row_model
from cucumbervision.run.measurer import CaptureResult, Failure, Measurer
from cucumbervision.service.requests import RequestError, bounded, check_source

ReplyT = TypeVar("ReplyT", "MeasureReply", "DetectReply")
Files = Annotated[
    list[UploadFile], File(description="One file or more, as for an upload.", min_length=1)
]

FruitRow: Any = row_model("FruitRow", FIELDS, pose=(FruitPose | None, None))
"""One fruit: the columns of the tables, in their units, and its pose."""

_PATHS = ("/", "/measure", "/detect", "/health", "/metrics", "/openapi.json")
_TIMES_S = (0.05, 0.1, 0.25, 0.5, 1, 2.5, 5, 10, 30, 60, 300)
_BODY_SLACK = 1_000_000  # part headers of a body with many files


class NotRead(BaseModel):
    """A file or capture that could not be read or measured."""

    name: str
    error: str = Field(description="Stable name, a class of cucumbervision.errors.")
    message: str

    @classmethod
    def of(cls, failure: Failure) -> NotRead:
        """Return the entry of a failure."""
        name = failure.capture or failure.input
        return cls(name=name, error=failure.error, message=failure.message)


class MeasuredCapture(BaseModel):
    """One capture and its fruit."""

    name: str
    width: int
    height: int
    simulated: bool
    fruit: list[FruitRow]

    @classmethod
    def of(cls, result: CaptureResult) -> MeasuredCapture:
        """Return the entry of a result."""
        pairs = zip(result.rows(), result.fruit, strict=True)
        names = ("name", "width", "height", "simulated")
        return cls(
            **{name: getattr(result.capture, name) for name in names},
            fruit=[FruitRow(**row, pose=fruit.pose) for row, fruit in pairs],
        )


class MeasureReply(BaseModel):
    """The results of one request."""

    version: Literal[1] = 1
    captures: list[MeasuredCapture]
    failures: list[NotRead]
    ignored: list[str] = Field(description="Files that are not needed.")
    config_sha256: str = Field(description="Hash of the options that were measured with.")


class DetectReply(BaseModel):
    """The detections in the images of one request."""

    version: Literal[1] = 1
    pictures: list[DetectedPicture]
    failures: list[NotRead]


class BusyError(errors.CucumberVisionError):
    """Too many requests are waiting."""


class LeftError(errors.CucumberVisionError):
    """The client has closed the connection before its turn."""


_STATUS = (
    (RequestError, 400),
    (errors.AccessError, 403),
    ((BusyError, errors.OutOfMemoryError), 503),
    (LeftError, 499),
    ((errors.InternalError, errors.FileError, errors.ModelError), 500),
)


def request_limits(most_mb: int = 200) -> Limits:
    """Return the limits of one request; zips may be four times as large when unpacked."""
    total = most_mb * 1_000_000
    return Limits(files=200, total_bytes=total, unpacked_bytes=4 * total)


@dataclass(frozen=True)
class ServiceSettings:
    """Access and limits of a service.

    Parameters
    ----------
    token : str
        Required by every request except `GET /health`; empty disables the check.
    limits : Limits
        Limits of one request; `total_bytes` applies to its whole body.
    waiting : int
        Requests that may wait for the current one; more are rejected with 503.
    body_s, silence_s : float
        Maximum time for a whole body, and between two parts of it, seconds.
    """

    token: str = field(default="", repr=False)
    limits: Limits = field(default_factory=request_limits)
    waiting: int = 8
    body_s: float = 600.0
    silence_s: float = 30.0


class Work:
    """The measurer of all requests, used by one at a time.

    Parameters
    ----------
    measurer : Measurer
        The measurer; loaded with the first request that needs it.
    settings : ServiceSettings
        Limits.
    """

    def __init__(self, measurer: Measurer, settings: ServiceSettings) -> None:
        self.measurer, self.settings = measurer, settings
        self._lock = threading.Lock()
        self._room = threading.BoundedSemaphore(settings.waiting + 1)

    @contextmanager
    def place(self) -> Iterator[None]:
        """Hold a place in the queue, from before the body is read until the answer.

        Raises
        ------
        BusyError
            If too many requests are waiting.
        """
        if not self._room.acquire(blocking=False):
            raise BusyError("too many requests are waiting", remedy="send it again later")
        try:
            yield
        finally:
            self._room.release()

    @contextmanager
    def turn(self, has_left: Callable[[], bool] = never) -> Iterator[Path]:
        """Wait for the measurer, and yield a folder for the files of the request.

        Raises
        ------
        LeftError
            If the client has left meanwhile.
        """
        with self._lock, tempfile.TemporaryDirectory(prefix="cucumbervision-") as folder:
            if has_left():
                raise LeftError("the client has left")
            self.measurer.load()
            yield Path(folder)

    def measure(
        self, files: Sequence[tuple[str, BinaryIO]], has_left: Callable[[], bool] = never
    ) -> MeasureReply:
        """Measure every capture of uploaded files; stop if the client has left.

        Raises
        ------
        CucumberVisionError
            If no file can be processed: too many files, a full disk, no networks.
        """
        options = self.measurer.options
        with self.turn(has_left) as folder:
            uploads = accept_uploads(files, folder, self.settings.limits)
            listed = chain.from_iterable(
                list_source(upload.title, partial(upload.open, options.reading))
                for upload in uploads.sources
            )
            results, failures = results_of(listed, ResultWorker(self.measurer), has_left)
        refused = [Failure.of(error, error.source) for error in uploads.refused]
        return MeasureReply(
            captures=[MeasuredCapture.of(result) for result in results],
            failures=[NotRead.of(failure) for failure in (*refused, *failures)],
            ignored=uploads.ignored,
            config_sha256=options.sha256,
        )

    def detect(
        self, files: Sequence[tuple[str, BinaryIO]], has_left: Callable[[], bool] = never
    ) -> DetectReply:
        """Find the fruit in uploaded images, without lengths; stop if the client has left.

        Raises
        ------
        CucumberVisionError
            As `measure`.
        """
        require_few(files, self.settings.limits)
        with self.turn(has_left) as folder:
            listed = []
            for k, (sent_name, stream) in enumerate(files):
                name = clean_name(sent_name)
                load = partial(_read, folder / f"{k:04d}", name, stream)
                listed.append(CaptureRef(name, 0, load, input=name))
            pictures, failures = results_of(listed, PictureWorker(self.measurer), has_left)
        return DetectReply(pictures=pictures, failures=[NotRead.of(x) for x in failures])


def _read(path: Path, name: str, stream: BinaryIO) -> Capture:
    """Read an uploaded image; it is stored under a generated name meanwhile."""
    try:
        path.write_bytes(stream.read())
        return replace(read_picture(path, name), source=name)
    except errors.CucumberVisionError as error:
        raise error.at(name) from None
    finally:
        path.unlink(missing_ok=True)


class _Metrics:
    """The Prometheus metrics."""

    def __init__(self) -> None:
        self.registry = prometheus_client.CollectorRegistry()
        counter = partial(
            prometheus_client.Counter, namespace="cucumbervision", registry=self.registry
        )
        self.requests = counter("requests", "Requests by path and status", ("path", "status"))
        self.results = counter("found", "Captures, images, fruit and failures", ("what",))
        self.seconds = prometheus_client.Histogram(
            "cucumbervision_request_seconds",
            "Time of admitted requests, waiting included",
            ("path",),
            buckets=_TIMES_S,
            registry=self.registry,
        )

    def count(self, path: str, status: int, taken_s: float) -> None:
        """Count a request, and record the time of an admitted one."""
        route = path if path in _PATHS else "other"
        self.requests.labels(route, str(status)).inc()
        if status not in (401, 403):
            self.seconds.labels(route).observe(taken_s)

    def counted(self, what: str, reply: ReplyT) -> ReplyT:
        """Count what an answer holds, and return it."""
        parts = getattr(reply, what)
        self.results.labels(what).inc(len(parts))
        self.results.labels("fruit").inc(sum(len(part.fruit) for part in parts))
        self.results.labels("failures").inc(len(reply.failures))
        return reply


def create_app(
    measurer: Measurer | None = None, settings: ServiceSettings | None = None
) -> FastAPI:
    """Return the service.

    Parameters
    ----------
    measurer : Measurer, optional
        The measurer.
    settings : ServiceSettings, optional
        Token and limits.

    Examples
    --------
    >>> sorted(create_app().openapi()["paths"])
    ['/', '/detect', '/health', '/measure', '/metrics']
    """
    work, metrics = Work(measurer or Measurer(), settings or ServiceSettings()), _Metrics()
    # No documentation pages: those of FastAPI load scripts from another server. Environment
    # variables could make FastAPI send traces.
    app = FastAPI(
        title="CucumberVision",
        version=__version__,
        description="Measures greenhouse cucumbers from RGB-D images.",
        docs_url=None,
        redoc_url=None,
        telemetry={"auto_configure": False, "tracing": False, "metrics": False, "logs": False},
    )

    @app.get("/")
    def root() -> dict[str, str]:
        """Return where the description of this interface is."""
        return {**software(), "api": "/openapi.json", "health": "/health"}

    @app.post("/measure")
    def measure(request: Request, files: Files) -> MeasureReply:
        """Measure every fruit of every capture: zipped capture folders, pairs."""
        return metrics.counted("captures", work.measure(_streams(files), _has_left(request)))

    @app.post("/detect")
    def detect(request: Request, files: Files) -> DetectReply:
        """Find cucumbers in plain images: boxes, masks and keypoints, no lengths."""
        return metrics.counted("pictures", work.detect(_streams(files), _has_left(request)))

    @app.get("/health")
    def health() -> dict[str, Any]:
        """Return status, version, source, and the networks that are loaded; needs no token."""
        return {"status": "ok", **software(), "models": [m["name"] for m in work.measurer.models]}

    @app.get("/metrics", response_class=PlainTextResponse)
    def tell_metrics() -> Response:
        """Return the metrics for Prometheus."""
        return Response(
            prometheus_client.generate_latest(metrics.registry),
            media_type=prometheus_client.CONTENT_TYPE_LATEST,
        )

    async def failed(_: Request, error: Exception) -> Response:
        return problem(error)

    kinds: tuple[type[Exception], ...] = (HTTPException, RequestValidationError)
    for kind in (*kinds, errors.CucumberVisionError, MemoryError, OSError, Exception):
        app.add_exception_handler(kind, failed)
    app.add_middleware(_Gate, work=work, metrics=metrics)
    return app


def _streams(files: list[UploadFile]) -> list[tuple[str, BinaryIO]]:
    return [(upload.filename or "unnamed", upload.file) for upload in files]


def _has_left(request: Request) -> Callable[[], bool]:
    """Return a function that a route's thread calls to learn whether the client has left."""
    return lambda: anyio.from_thread.run(request.is_disconnected)


def problem(error: Exception, **headers: str) -> Response:
    """Return why a request was refused."""
    if isinstance(error, HTTPException):
        status, code, text = error.status_code, "HTTPError", str(error.detail)
        headers |= error.headers or {}
    elif isinstance(error, RequestValidationError):
        faults = (f"{'.'.join(map(str, fault['loc']))}: {fault['msg']}" for fault in error.errors())
        status, code, text = 422, "RequestError", "; ".join(faults)[:1000]
    else:
        named = errors.named_error(error)
        code, text = named.code, str(named)
        status = next((number for kind, number in _STATUS if isinstance(named, kind)), 422)
    if status == 503:
        headers["Retry-After"] = "1"
    return JSONResponse({"error": code, "message": text}, status, headers)


class _Gate:
    """Admits or refuses a request before its body is read, and ends requests that stall."""

    def __init__(self, app: Any, work: Work, metrics: _Metrics) -> None:
        self._app, self._work, self._count = app, work, metrics.count

    async def __call__(self, scope: Any, receive: Any, send: Any) -> None:
        """Answer a request, or pass it on."""
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        begun_s, status = time.perf_counter(), 500

        async def noting(message: Any) -> None:
            nonlocal status
            status = message.get("status", status)
            await send(message)

        try:
            await self._admit(Headers(scope=scope), scope, receive, noting)
        except (RequestError, errors.AccessError, BusyError) as error:
            await problem(error, Connection="close")(scope, receive, noting)
        except HTTPException as error:
            await problem(error)(scope, receive, noting)
        finally:
            self._count(scope["path"], status, time.perf_counter() - begun_s)

    async def _admit(self, headers: Headers, scope: Any, receive: Any, send: Any) -> None:
        settings, path = self._work.settings, scope["path"]
        check_source(headers, method=scope["method"], local=not settings.token)
        scheme, _, token = headers.get("authorization", "").partition(" ")
        given = token if scheme.lower() == "bearer" else ""
        is_right = hmac.compare_digest(given.encode(), settings.token.encode())
        if settings.token and path != "/health" and not is_right:
            asked = {"WWW-Authenticate": "Bearer"}
            raise HTTPException(401, "the token is missing or wrong", asked)
        has_body = path in ("/measure", "/detect") and scope["method"] == "POST"
        most_bytes = settings.limits.total_bytes + _BODY_SLACK if has_body else 0
        times = {"body_s": settings.body_s, "silence_s": settings.silence_s}
        receive = bounded(receive, headers, most_bytes, **times)
        with self._work.place() if has_body else nullcontext():
            await self._app(scope, receive, send)
