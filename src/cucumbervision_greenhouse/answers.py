"""Routes of both applications: JSON answers, changes by WebSocket, news."""

from __future__ import annotations

from collections.abc import Awaitable, Callable
from functools import wraps
from typing import Annotated, Any

from pydantic import BaseModel, ConfigDict, Field, ValidationError
from starlette.concurrency import run_in_threadpool
from starlette.exceptions import HTTPException
from starlette.requests import ClientDisconnect, Request
from starlette.responses import JSONResponse, Response

from cucumbervision.errors import CucumberVisionError, DiskFullError, named_error
from cucumbervision_greenhouse import resources
from cucumbervision_greenhouse.access import device_of
from cucumbervision_greenhouse.language import ask_for, words_of
from cucumbervision_greenhouse.language import gettext as _

Key = Annotated[str, Field(pattern=r"^[0-9a-f-]{36}$")]
"""Key of a round, stop or upload."""


class Sent(BaseModel):
    """The content of a request; unknown fields are refused."""

    model_config = ConfigDict(extra="forbid", allow_inf_nan=False)


def answer(work: Callable[[Request, Any], Any]) -> Callable[[Request], Awaitable[Response]]:
    """Make a route from a function of a request and its content, and send its result as JSON.

    A named error is answered in one line for people, with status 409, and its fault in English; a
    full disk with 507, another fault of a file with 500.
    """

    @wraps(work)
    async def route(request: Request) -> Response:
        try:
            content = await request.body() if request.method == "POST" else b""
        except HTTPException as error:  # too large or too slow, as `AccessGuard` found
            return JSONResponse({"error": error.detail}, error.status_code, error.headers)
        except ClientDisconnect:  # lost on the way, as happens among plants: nobody reads an answer
            return Response(status_code=400)
        ask_for(request.headers.get("accept-language"))
        try:
            reply = await run_in_threadpool(work, request, content)
        except CucumberVisionError as error:
            return JSONResponse({"error": words_of(error), "fault": error.message}, 409)
        except OSError as error:  # from 500 on, a part of an upload is sent again
            named = named_error(error)
            if not isinstance(named, DiskFullError):
                return JSONResponse({"error": words_of(named)}, 500)
            words = _("The computer cannot store more ({reason}): free some space on its disk")
            return JSONResponse({"error": words.format(reason=_(error.strerror or ""))}, 507)
        except ValidationError:
            return JSONResponse({"error": _("the request is damaged; reload the page")}, 400)
        if isinstance(reply, Response):
            return reply
        return JSONResponse(reply, headers={"cache-control": "no-store"})

    return route


def store_of(request: Request) -> Any:
    """Return the store, signed by the one who sent a request."""
    name = request.scope.get("viewer") or "dashboard"
    return resources.store().signed(name, device_of(request.cookies))
