from __future__ import annotations

import math
import uuid

import numpy as np
import pytest

from cucumbervision.errors import StoreError
from cucumbervision_greenhouse.store.records import checked_key, key_of, new_key, record_json


def test_new_keys_differ_and_made_keys_do_not() -> None:
    assert new_key() != new_key()
    assert key_of("a", 1) == key_of("a", "1")
    # Parts are not merely strung together.
    assert len({key_of("a", "bc"), key_of("ab", "c"), key_of("abc")}) == 3
    assert uuid.UUID(key_of("a")).version == 5


@pytest.mark.parametrize("key", ["", "stop-1", None, 7])
def test_what_is_no_uuid_is_refused_by_name(key: str) -> None:
    with pytest.raises(StoreError, match=r"stop key .* is not a UUID; take one"):
        checked_key(key, "stop")


def test_a_key_is_the_same_however_it_is_written() -> None:
    key = new_key()
    assert checked_key(key.upper(), "stop") == key
    assert checked_key(key.replace("-", ""), "stop") == key


@pytest.mark.parametrize("value", [math.nan, math.inf, np.float32(0.2)])
def test_only_finite_plain_numbers_are_stored(value: float) -> None:
    with pytest.raises(StoreError, match="cannot be stored"):
        record_json({"length_m": value})
