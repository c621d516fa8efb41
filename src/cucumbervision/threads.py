"""Limit BLAS to one thread for this package's matrices.

They are small: with threads of its own, BLAS spends several times the processor time on them.
"""

from __future__ import annotations

import threading
from contextlib import ContextDecorator
from functools import cache
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from typing import Self


class OneThread(ContextDecorator):
    """Holds BLAS to one thread inside a `with` block or a decorated function.

    The limit is the process's. Blocks may nest and run side by side: the first one to begin keeps
    the process's own setting, and the last one to end restores it. Threads of networks are not
    limited.

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
        """Restore what was set before, if no other block is left."""
        cls = OneThread
        with cls._lock:
            cls._inside -= 1
            if not cls._inside:
                cls._limit.restore_original_limits()
                cls._limit = None


@cache
def _blas() -> Any:
    # Only libraries that are loaded already are found: SciPy has a BLAS of its own.
    import scipy.linalg  # noqa: F401
    from threadpoolctl import ThreadpoolController

    return ThreadpoolController().select(user_api="blas")
