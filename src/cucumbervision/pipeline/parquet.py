"""Tables as Parquet, with units and meaning beside the columns."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, Any

from cucumbervision.errors import MissingExtraError

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping
    from types import ModuleType

    from cucumbervision.pipeline.fields import Column

__all__ = ["arrow_schema", "import_arrow"]


def import_arrow() -> ModuleType:
    """Import pyarrow with its Parquet part.

    Raises
    ------
    MissingExtraError
        If it is not installed.
    """
    try:
        import pyarrow
        import pyarrow.parquet
    except ModuleNotFoundError:
        raise MissingExtraError("pyarrow", "export") from None
    module: ModuleType = pyarrow
    return module


def arrow_schema(columns: Iterable[Column], provenance: Mapping[str, Any]) -> Any:
    """Return a table's schema: types, units and words a column, provenance with the file."""
    pa = import_arrow()
    kinds: dict[str, Any] = {
        "text": pa.string(),
        "whole": pa.int64(),
        "number": pa.float64(),
        "yes/no": pa.bool_(),
    }
    fields = [
        pa.field(one.name, kinds[one.type], metadata={"unit": one.unit, "says": one.says})
        for one in columns
    ]
    about = {"cucumbervision": json.dumps(dict(provenance), ensure_ascii=False)}
    return pa.schema(fields, metadata=about)
