"""Start the service."""

from __future__ import annotations

import os
from typing import TYPE_CHECKING

from cucumbervision.service.settings import (
    TOKEN_VARIABLE,
    ServiceSettings,
    check_access,
    require_extra,
)

if TYPE_CHECKING:
    from collections.abc import Callable

    from cucumbervision.pipeline.options import MeasureOptions


def serve(
    options: MeasureOptions,
    settings: ServiceSettings | None = None,
    *,
    address: str = "127.0.0.1",
    port: int = 8600,
    ready: Callable[[], None] = lambda: None,
) -> None:
    """Serve until it is interrupted; what is being measured then is answered first.

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
        Called when the networks are loaded, before it listens.

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
    import uvicorn

    from cucumbervision.pipeline.measurer import Measurer
    from cucumbervision.service.app import create_app

    measurer = Measurer(options)
    measurer.warm_up()
    app = create_app(measurer, settings)
    ready()
    uvicorn.run(app, host=address, port=port, log_level="warning", server_header=False)
