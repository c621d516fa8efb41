"""Limit BLAS to one thread for this package's matrices.

The matrices are small: with several threads, BLAS needs several times the processor time.
"""

from __future__ import annotations

import threading
from contextlib import ContextDecorator
from functools import cache
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from typing import Self


class OneThread(ContextDecorator):
    """Limits BLAS to one thread inside a `with` block or a decorated function.

    The limit applies to the process. Blocks may be nested and concurrent: the first block saves the
    setting of the process, and the last one restores it. Threads of networks are not limited.

    Examples
    --------
    >>> import numpy as np
    >>> with OneThread():
    ...     round(float(np.linalg.det(2 * np.eye(3))))
    8
    """

    _lock = threading.Lock()
    _inside = 0
    _limit: Any = None

    def __enter__(self) -> Self:
        """Limit BLAS, unless it is limited already."""
        cls = OneThread
        with cls._lock:
            if not cls._inside:
                cls._limit = _blas().limit(limits=1)
            cls._inside += 1
        return self

    def __exit__(self, *_: object) -> None:
        """Restore the previous setting, if no other block is active."""
        cls = OneThread
        with cls._lock:
            cls._inside -= 1
            if not cls._inside:
                cls._limit.restore_original_limits()
                cls._limit = None


@cache
def _blas() -> Any:
    # Only loaded libraries are limited: of SciPy's own BLAS measuring calls nothing.
    from threadpoolctl import ThreadpoolController

    return ThreadpoolController().select(user_api="blas")
