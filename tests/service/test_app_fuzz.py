"""Requests that nobody would write, by schemathesis from the service's own description."""

from __future__ import annotations

from typing import Any

import pytest

pytest.importorskip("fastapi")
pytest.importorskip("schemathesis")

import schemathesis
from hypothesis import HealthCheck, settings
from schemathesis.specs.openapi.checks import negative_data_rejection

from cucumbervision.run.measurer import Measurer
from cucumbervision.run.options import MeasureOptions
from cucumbervision.service.app import ServiceSettings, create_app, request_limits

TOKEN = "0123456789abcdef"
app = create_app(
    Measurer(MeasureOptions(instances="dataset")), ServiceSettings(TOKEN, request_limits(1))
)
description = schemathesis.openapi.from_dict(app.openapi())
description.app = app


@description.parametrize()
@settings(max_examples=10, deadline=None, suppress_health_check=list(HealthCheck), database=None)
def test_every_answer_is_as_described(case: Any) -> None:
    # What schemathesis takes for a wrong file is one all the same: a part of a form is bytes.
    left_out = [negative_data_rejection]
    case.call_and_validate(headers={"Authorization": f"Bearer {TOKEN}"}, excluded_checks=left_out)
