"""The service's routes, access control and metrics."""

from __future__ import annotations

from collections.abc import Callable
from typing import Annotated, Any, BinaryIO

import anyio.from_thread
from fastapi import APIRouter, Depends, FastAPI, File, Request, Response, UploadFile
from fastapi.exceptions import RequestValidationError
from fastapi.security import HTTPBearer
from prometheus_client import (
    CONTENT_TYPE_LATEST,
    CollectorRegistry,
    Counter,
    Histogram,
    generate_latest,
)
from starlette.exceptions import HTTPException

from cucumbervision._version import __version__
from cucumbervision.about import software
from cucumbervision.errors import (
    CucumberVisionError,
    FileError,
    InternalError,
    ModelError,
    OutOfMemoryError,
    named_error,
)
from cucumbervision.pipeline.measurer import Measurer
from cucumbervision.service.gate import REFUSALS, Gate, problem
from cucumbervision.service.server import ServiceSettings
from cucumbervision.service.work import (
    BusyError,
    DetectReply,
    Health,
    LeftError,
    MeasureReply,
    Problem,
    Work,
)

_REFUSED = {
    400: "The body cannot be parsed, or a header is malformed.",
    401: "No token, or a wrong one.",
    403: "A page of another site sent it, or it names another host.",
    408: "The body does not come on.",
    413: "The body is larger than the limit.",
    422: "The request has no usable files.",
    500: "A defect of the software, a full disk, or a network that cannot be loaded.",
    503: "Too many requests wait, or there is no memory.",
}
_RESPONSES: dict[int | str, dict[str, Any]] = {
    status: {"model": Problem, "description": text} for status, text in _REFUSED.items()
}
_bearer = HTTPBearer(auto_error=False, description="The service's token.")
Files = Annotated[
    list[UploadFile], File(description="One file or more, as for an upload.", min_length=1)
]


class _Metrics:
    """The Prometheus metrics."""

    def __init__(self) -> None:
        self.registry = CollectorRegistry()
        self.requests = Counter(
            "cucumbervision_requests",
            "Requests by path and status",
            ("path", "status"),
            registry=self.registry,
        )
        self.results = Counter(
            "cucumbervision_found",
            "Captures, pictures, fruit and failures of answers",
            ("what",),
            registry=self.registry,
        )
        self.seconds = Histogram(
            "cucumbervision_request_seconds",
            "Time of requests that were answered, waiting included",
            ("path",),
            registry=self.registry,
            buckets=(0.05, 0.1, 0.25, 0.5, 1, 2.5, 5, 10, 30, 60, 300),
        )

    def count(self, path: str, status: int, seconds: float) -> None:
        """Count a request; record the time of an admitted one."""
        route = path if path in _PATHS else "other"
        self.requests.labels(route, str(status)).inc()
        if status not in REFUSALS:
            self.seconds.labels(route).observe(seconds)


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
    ['/detect', '/health', '/measure', '/metrics']
    """
    settings = settings or ServiceSettings()
    work, metrics = Work(measurer or Measurer(), settings), _Metrics()
    # No documentation pages: those of FastAPI load scripts from another server.
    app = FastAPI(
        title="CucumberVision",
        version=__version__,
        description="Measures greenhouse cucumbers from RGB-D pictures.",
        docs_url=None,
        redoc_url=None,
        # Environment variables could make FastAPI send traces.
        telemetry={"auto_configure": False, "tracing": False, "metrics": False, "logs": False},
    )
    app.include_router(_routes(work, metrics))
    _answer_errors(app)
    app.add_middleware(Gate, settings=settings, count=metrics.count, place=work.place)
    return app


_PATHS = frozenset({"/measure", "/detect", "/health", "/metrics", "/openapi.json"})


def _routes(work: Work, metrics: _Metrics) -> APIRouter:
    """Return the four routes."""
    routes = APIRouter()
    secured: dict[str, Any] = {
        "responses": _RESPONSES,
        "dependencies": [Depends(_bearer)] if work.settings.token else [],
    }

    @routes.post("/measure", response_model=MeasureReply, **secured)
    def measure(request: Request, files: Files) -> MeasureReply:
        """Measure every fruit of every capture: zipped capture folders, pairs."""
        reply = work.measure(_streams(files), _has_left(request))
        metrics.results.labels("captures").inc(len(reply.captures))
        metrics.results.labels("fruit").inc(sum(len(capture.fruit) for capture in reply.captures))
        metrics.results.labels("failures").inc(len(reply.failures))
        return reply

    @routes.post("/detect", response_model=DetectReply, **secured)
    def detect(request: Request, files: Files) -> DetectReply:
        """Find cucumbers in plain pictures: boxes, masks and keypoints, no lengths."""
        reply = work.detect(_streams(files), _has_left(request))
        metrics.results.labels("pictures").inc(len(reply.pictures))
        metrics.results.labels("fruit").inc(sum(len(picture.fruit) for picture in reply.pictures))
        metrics.results.labels("failures").inc(len(reply.failures))
        return reply

    @routes.get("/health", response_model=Health)
    def health() -> Health:
        """Return the service's status, version and source; needs no token."""
        names = [str(model["name"]) for model in work.measurer.models]
        package = software()
        return Health(
            status="ok",
            software=package["software"],
            licence=package["licence"],
            source=package["source"],
            models=names,
        )

    @routes.get("/metrics", response_class=Response, **_only(secured, 401))
    def tell_metrics() -> Response:
        """Return the metrics for Prometheus."""
        return Response(generate_latest(metrics.registry), media_type=CONTENT_TYPE_LATEST)

    return routes


def _only(secured: dict[str, Any], status: int) -> dict[str, Any]:
    text = {"description": "Metrics in Prometheus' text format.", "content": {"text/plain": {}}}
    return {**secured, "responses": {200: text, status: _RESPONSES[status]}}


def _streams(files: list[UploadFile]) -> list[tuple[str, BinaryIO]]:
    return [(upload.filename or "unnamed", upload.file) for upload in files]


def _has_left(request: Request) -> Callable[[], bool]:
    """Return a function that a route's thread calls to learn whether the client has left."""
    return lambda: anyio.from_thread.run(request.is_disconnected)


def _answer_errors(app: FastAPI) -> None:
    """Answer every exception with a `Problem`."""

    @app.exception_handler(HTTPException)
    async def refused(_: Request, error: HTTPException) -> Response:
        response = problem(error.status_code, "HTTPError", str(error.detail))
        response.headers.update(error.headers or {})
        return response

    @app.exception_handler(RequestValidationError)
    async def invalid(_: Request, error: RequestValidationError) -> Response:
        faults = [f"{'.'.join(map(str, fault['loc']))}: {fault['msg']}" for fault in error.errors()]
        return problem(422, "RequestError", "; ".join(faults)[:1000])

    async def failed(_: Request, error: Exception) -> Response:
        named = named_error(error)
        status = 422
        if isinstance(named, InternalError | FileError | ModelError):
            status = 500
        elif isinstance(named, BusyError | OutOfMemoryError):
            status = 503
        elif isinstance(named, LeftError):
            status = 499
        response = problem(status, named.code, str(named))
        if status == 503:
            response.headers["Retry-After"] = "1"
        return response

    for kind in (CucumberVisionError, MemoryError, OSError, Exception):
        app.add_exception_handler(kind, failed)
