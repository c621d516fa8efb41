"""What the service answers: models made of the one table of fields."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from pydantic import BaseModel, Field, create_model

from cucumbervision.pipeline.fields import FIELDS

if TYPE_CHECKING:
    from cucumbervision.pipeline.measurer import CaptureResult, Failure

_TYPES = {"text": str, "whole": int, "number": float, "yes/no": bool}

_COLUMNS: dict[str, Any] = {
    one.name: (_TYPES[one.type] | None, Field(None, description=one.says)) for one in FIELDS
}
FruitRow: Any = create_model("FruitRow", **_COLUMNS)
"""One fruit: the columns of the tables, in their units."""


class NotRead(BaseModel):
    """What could not be read or measured: the sender's name for it, and why."""

    name: str
    error: str = Field(description="Stable name, a class of cucumbervision.errors.")
    message: str


class MeasuredCapture(BaseModel):
    """One capture and its fruit."""

    name: str
    width: int
    height: int
    simulated: bool
    fruit: list[FruitRow]


class MeasureReply(BaseModel):
    """What was measured of one request."""

    captures: list[MeasuredCapture]
    failures: list[NotRead]
    ignored: list[str] = Field(description="Files that are not needed.")
    config_sha256: str = Field(description="Hash of the options that were measured with.")


class SeenPicture(BaseModel):
    """One picture and the fruit found in it."""

    name: str
    width: int
    height: int
    fruit: list[dict[str, Any]] = Field(
        description="As COCO's results: bbox, score, segmentation, keypoints; and the class name."
    )


class DetectReply(BaseModel):
    """What was found in the pictures of one request."""

    pictures: list[SeenPicture]
    failures: list[NotRead]


class Health(BaseModel):
    """Whether the service works, and what it is."""

    status: str
    software: str
    licence: str
    source: str
    models: list[str] = Field(description="Networks that are loaded so far.")


class Problem(BaseModel):
    """Why a request was refused."""

    error: str
    message: str


def measured_capture(result: CaptureResult) -> MeasuredCapture:
    """Return one capture of an answer."""
    capture = result.capture
    return MeasuredCapture(
        name=capture.name,
        width=capture.width,
        height=capture.height,
        simulated=capture.simulated,
        fruit=[FruitRow(**row) for row in result.rows()],
    )


def not_read(failure: Failure) -> NotRead:
    """Return one failure of an answer."""
    name = failure.capture or failure.input
    return NotRead(name=name, error=failure.error, message=failure.message)
