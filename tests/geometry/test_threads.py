from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest
import scipy.linalg  # noqa: F401
from threadpoolctl import threadpool_info, threadpool_limits

from cucumbervision.capture.frames import Capture
from cucumbervision.capture.intrinsics import Intrinsics
from cucumbervision.geometry.threads import OneThread
from cucumbervision.measurement import methods
from cucumbervision.measurement.result import Measurement, Method
from cucumbervision.measurement.selector import measure_fruit
from cucumbervision.perception.instances import Instance


def blas_threads() -> set[int]:
    return {one["num_threads"] for one in threadpool_info() if one["user_api"] == "blas"}


@pytest.fixture(autouse=True)
def of_the_user() -> Iterator[None]:
    """Three threads, whatever this machine and its environment say."""
    with threadpool_limits(3, user_api="blas"):
        yield


def test_a_fruit_is_measured_on_one_thread_and_the_users_setting_stands_after_it(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    during = []
    run = methods._RUN[Method.M2]

    def observed(region: methods.Region) -> Measurement:
        during.append(blas_threads())
        return run(region)

    monkeypatch.setitem(methods._RUN, Method.M2, observed)
    lens = Intrinsics(640, 480, 600.0, 600.0, 320.0, 240.0)
    depth = np.full((480, 640), 0.6, np.float32)
    capture = Capture(np.zeros((480, 640, 3), np.uint8), depth, lens, "a")
    fruit = measure_fruit(capture, Instance(np.array([219.5, 229.5, 419.5, 249.5])))
    assert fruit.length is not None
    assert during == [{1}]
    assert blas_threads() == {3}


def test_blocks_side_by_side_restore_what_was_set_before_the_first_of_them() -> None:
    # As of two threads of a program, of which the first to begin is the first to end.
    first, second = OneThread(), OneThread()
    first.__enter__()
    second.__enter__()
    first.__exit__()
    assert blas_threads() == {1}
    second.__exit__()
    assert blas_threads() == {3}


def test_an_error_inside_restores_it_too() -> None:
    with pytest.raises(np.linalg.LinAlgError), OneThread():
        np.linalg.inv(np.zeros((2, 2)))
    assert blas_threads() == {3}
