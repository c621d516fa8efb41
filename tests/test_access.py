from __future__ import annotations

import pytest

from cucumbervision.access import check_access
from cucumbervision.errors import AccessError

TOKEN = "a-token-of-the-tests"


@pytest.mark.parametrize(
    ("address", "token"), [("0.0.0.0", ""), ("", ""), ("::", ""), ("127.0.0.1", "short")]
)
def test_other_machines_need_a_token(address: str, token: str) -> None:
    with pytest.raises(AccessError):
        check_access(address, token)
    check_access("localhost", "")
    check_access(address, TOKEN)
