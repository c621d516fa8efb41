from __future__ import annotations

import json

import jsonschema
import pytest
from typer.testing import CliRunner

from cucumbervision.cli.app import app


@pytest.mark.parametrize(
    ("kind", "holds"), [("stream", "fruit"), ("measure", "captures"), ("detect", "pictures")]
)
def test_a_schema_is_one_and_names_its_version(kind: str, holds: str) -> None:
    schema = json.loads(CliRunner().invoke(app, ["schema", kind]).output)
    jsonschema.Draft202012Validator.check_schema(schema)
    assert schema["properties"]["version"]["const"] == 1
    assert holds in schema["required"]
    described = [one.get("description", "") for one in schema["$defs"].values()]
    assert not [text for text in described if "\n" in text]
