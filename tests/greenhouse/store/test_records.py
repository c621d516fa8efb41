from __future__ import annotations

import math
import uuid

import numpy as np
import pytest

from cucumbervision.errors import StoreError
from cucumbervision_greenhouse.store.engine import stored_json
from cucumbervision_greenhouse.store.records import key_of, new_key


def test_new_keys_differ_and_made_keys_do_not() -> None:
    assert new_key() != new_key()
    assert key_of("a", 1) == key_of("a", "1")
    # Parts are not merely strung together.
    assert len({key_of("a", "bc"), key_of("ab", "c"), key_of("abc")}) == 3
    assert uuid.UUID(key_of("a")).version == 5


@pytest.mark.parametrize("value", [math.nan, math.inf, np.float32(0.2)])
def test_only_finite_plain_numbers_are_stored(value: float) -> None:
    with pytest.raises(StoreError, match="cannot be stored"):
        stored_json({"length_m": value})
