"""The service's settings, the check of its address and token, and its start."""

from __future__ import annotations

import hmac
import os
from dataclasses import dataclass, field
from importlib.util import find_spec
from typing import TYPE_CHECKING

from cucumbervision.access import TOKEN_VARIABLE, check_access
from cucumbervision.errors import MissingExtraError
from cucumbervision.intake.uploads import Limits

if TYPE_CHECKING:
    from collections.abc import Callable

    from cucumbervision.pipeline.options import MeasureOptions

_MB = 1_000_000


def request_limits(most_mb: int = 200) -> Limits:
    """Return the limits of one request; zips may be four times as large when unpacked."""
    total_bytes = most_mb * _MB
    return Limits(
        files=200, file_bytes=total_bytes, total_bytes=total_bytes, unpacked_bytes=4 * total_bytes
    )


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

    def admits(self, token: str) -> bool:
        """Return whether a token is correct, in constant time.

        Examples
        --------
        >>> ServiceSettings("0123456789abcdef").admits("0123456789abcdeF")
        False
        """
        return not self.token or hmac.compare_digest(token.encode(), self.token.encode())


def require_extra() -> None:
    """Raise MissingExtraError if a package of the extra 'serve' is not installed."""
    packages = ("fastapi", "uvicorn", "prometheus_client", "python_multipart")
    for package in packages:
        if find_spec(package) is None:
            raise MissingExtraError(package.replace("_", "-"), "serve")


def serve(
    options: MeasureOptions,
    settings: ServiceSettings | None = None,
    *,
    address: str = "127.0.0.1",
    port: int = 8600,
    ready: Callable[[], None] = lambda: None,
) -> None:
    """Serve until interrupted; the current request is answered first.

    Parameters
    ----------
    options : MeasureOptions
        How to measure.
    settings : ServiceSettings, optional
        Token and limits; by default with the token of the environment's `CUCUMBERVISION_TOKEN`.
    address : str
        Address to bind to.
    port : int
        TCP port.
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
    require_extra()
    settings = settings or ServiceSettings(os.environ.get(TOKEN_VARIABLE, ""))
    check_access(address, settings.token)
    from cucumbervision.pipeline.measurer import Measurer
    from cucumbervision.service.app import create_app
    from cucumbervision.service.requests import listen

    measurer = Measurer(options)
    measurer.warm_up()
    app = create_app(measurer, settings)
    ready()
    listen(app, address, port)
