"""Call the compiled fit of `kernel/` (C), which computes what NumPy does in `fit` and `evidence`.

The library is built when the package is installed, where there is a C compiler. Without it, and
with `CUCUMBERVISION_KERNEL=numpy` in the environment, NumPy computes; so it does where something is
odd: numbers that are not finite, arrays that do not fit together, equations without a solution.
"""

from __future__ import annotations

import ctypes
import hashlib
import os
import struct
import threading
from contextlib import ContextDecorator
from functools import cache
from pathlib import Path
from typing import Any, Self, TypeAlias

import numpy as np

from cucumbervision.arrays import Array, Numbers
from cucumbervision.tube.evidence import Evidence
from cucumbervision.tube.shape import BALLS, BEND_SEGMENTS, FINE, WIDTH_SEGMENTS, TubeShape, bases

FOLDER = Path(__file__).parent / "kernel"
_BODY = 3 * (BEND_SEGMENTS + 3) + (WIDTH_SEGMENTS + 3) + 3
_TILE, _ROWS = 4, 48  # of kernel.h
_MOST_WAVES = 1000


class OneThread(ContextDecorator):
    """Limits BLAS to one thread inside a `with` block or a decorated function.

    The matrices are small: with several threads, BLAS needs several times the processor time. The
    limit applies to the process. Blocks may be nested and concurrent: the first block saves the
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


def kernel_name() -> str:
    """Return which kernel computes M6: `compiled` or `numpy`.

    Examples
    --------
    >>> kernel_name() in ("compiled", "numpy")
    True
    """
    return "numpy" if library() is None else "compiled"


def _is_whole(path: Path) -> bool:
    """Return whether a library is as it was compiled, from these sources, by the hash beside it.

    Loading a damaged library may end the process, so it is compared before it is loaded.
    """
    content = b"".join(part.read_bytes() for part in (path, *sorted(FOLDER.glob("*.[ch]"))))
    return hashlib.sha256(content).hexdigest() == path.with_suffix(".sha256").read_text("ascii")


@cache
def library() -> Any:
    """Load the compiled kernel; None without one, and where NumPy is asked for."""
    if os.environ.get("CUCUMBERVISION_KERNEL", "").strip().lower() == "numpy":
        return None
    path = FOLDER / "kernel.so"
    try:
        if not _is_whole(path):
            return None
        loaded = ctypes.CDLL(str(path))
    except (OSError, ValueError):
        return None
    return loaded


class _Struct:
    """A struct of kernel.h: counts, floats and addresses of arrays, of 8 bytes each."""

    def __init__(self, *values: Any) -> None:
        self.arrays = [value for value in values if isinstance(value, np.ndarray)]
        kinds = "".join("d" if isinstance(value, float) else "q" for value in values)
        words = (v.ctypes.data if isinstance(v, np.ndarray) else v for v in values)
        self.argument = ctypes.c_char_p(struct.pack(kinds, *words))


def _readings(count: int) -> _Struct:
    """Return room for gaps, unit vectors, centres, facing, errors and positions of readings."""
    gap_m, facing, sd_m, scratch = np.empty((4, count))
    away, centres_m = np.empty((2, count, 3))
    return _Struct(gap_m, away, centres_m, facing, sd_m, scratch, np.empty(count, np.int64))


@cache
def _bases() -> _Struct:
    return _Struct(*bases(BALLS), *bases(FINE + 1))


def _numbers(array: Numbers, *shape: int) -> Array:
    # As the kernel reads it; ValueError if it has another shape.
    return np.ascontiguousarray(array, np.float64).reshape(shape)


Fit: TypeAlias = "tuple[Array, Array, list[Numbers], list[Numbers], Array, Numbers, float]"
"""Control points of centres and of radii, points, rays, covariance, which ends are seen, misfit."""


def _padded(waves: int) -> int:
    return _TILE * (-(-waves // _TILE))


def _evidence(evidence: Evidence) -> _Struct:
    count, rays, waves = len(evidence.points_m), len(evidence.rays), evidence.waves
    waves_m = np.zeros((count, _padded(waves)))
    if evidence.waves_m is not None:
        waves_m[:, :waves] = _numbers(evidence.waves_m, count, waves)
    return _Struct(
        count,
        rays,
        waves,
        _numbers(evidence.points_m, count, 3),
        _numbers(evidence.directions, count, 3),
        _numbers(evidence.points_far_m, count),
        _numbers(evidence.points_sd_m, count),
        _numbers(evidence.rays, rays, 3),
        waves_m,
        float(evidence.rays_sd_rad),
        float(evidence.points_share),
        float(evidence.rays_share),
        float(evidence.pixel_rad * evidence.far_m),
        float(evidence.far_m),
    )


def fitted(evidence: Evidence, guess: TubeShape) -> Fit | None:
    """Fit as `tube_fit.fit_shape`; None where NumPy must, or without a solution."""
    count, waves = len(evidence.points_m), evidence.waves
    if library() is None or waves > _MOST_WAVES or not count:
        return None
    scalars = np.array((evidence.rays_sd_rad, evidence.pixel_rad, evidence.points_share))
    numbers = [evidence.points_m, evidence.points_sd_m, evidence.rays, evidence.waves_m, scalars]
    numbers += [guess.bend_m, guess.width_m]
    if not all(np.isfinite(array).all() for array in numbers if array is not None):
        return None
    # Copies: the fit moves them.
    bend_m = np.array(guess.bend_m, np.float64).reshape(BEND_SEGMENTS + 3, 3)
    width_m = np.array(guess.width_m, np.float64).reshape(WIDTH_SEGMENTS + 3)
    points, rays = _readings(count), _readings(len(evidence.rays))
    stride = _BODY + _padded(waves) + 1
    equations = np.zeros((stride, stride)), np.zeros(stride), np.empty(_ROWS * stride)
    covariance, ends, misfit = np.empty((_BODY, _BODY)), np.ones(2, np.int64), np.zeros(1)
    values = (
        *(_bases(), _evidence(evidence), _Struct(bend_m, width_m), np.zeros(3 + waves)),
        *(points, rays, _Struct(_BODY + waves, stride, *equations), covariance, ends, misfit),
    )
    is_solved = library().fit_shape(
        *(x.argument if isinstance(x, _Struct) else ctypes.c_void_p(x.ctypes.data) for x in values)
    )
    moved = bend_m, width_m, points.arrays, rays.arrays
    return (*moved, covariance, ends, float(misfit[0])) if is_solved else None
