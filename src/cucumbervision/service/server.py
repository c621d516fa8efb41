"""The start of the service, and the check of its address and token."""

from __future__ import annotations

import os
from importlib.util import find_spec
from typing import TYPE_CHECKING

from cucumbervision.access import TOKEN_VARIABLE, check_access
from cucumbervision.errors import MissingExtraError

if TYPE_CHECKING:
    from collections.abc import Callable

    from cucumbervision.run.options import MeasureOptions


def serve(
    options: MeasureOptions,
    *,
    address: str = "127.0.0.1",
    port: int = 8600,
    most_mb: int = 200,
    waiting: int = 8,
    ready: Callable[[], None] = lambda: None,
) -> None:
    """Serve until interrupted; the current request is answered first.

    Parameters
    ----------
    options : MeasureOptions
        How to measure.
    address, port : str, int
        Address to bind to; one that other machines can reach needs the environment's
        `CUCUMBERVISION_TOKEN`.
    most_mb, waiting : int
        Megabytes of a request, and number of requests that wait, at most.
    ready : callable
        Called after the networks are loaded, before listening.

    Raises
    ------
    MissingExtraError
        If the extra 'serve' is not installed.
    AccessError
        If other machines can reach the address and there is no token.
    CucumberVisionError
        If a network or the calibration cannot be loaded.
    """
    for package in ("fastapi", "uvicorn", "prometheus_client", "python_multipart"):
        if find_spec(package) is None:
            raise MissingExtraError(package.replace("_", "-"), "serve")
    token = os.environ.get(TOKEN_VARIABLE, "")
    check_access(address, token)
    from cucumbervision.run.measurer import Measurer
    from cucumbervision.service.app import ServiceSettings, create_app, request_limits
    from cucumbervision.service.requests import listen

    measurer = Measurer(options)
    measurer.warm_up()
    app = create_app(measurer, ServiceSettings(token, request_limits(most_mb), waiting))
    ready()
    listen(app, address, port)
