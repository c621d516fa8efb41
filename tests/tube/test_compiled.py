"""The compiled functions against NumPy's, to rounding: the latter have tests of their own."""

from __future__ import annotations

import multiprocessing
import shutil
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import scipy.linalg  # noqa: F401
from tests.tube.test_fit import surface, tangent_rays
from threadpoolctl import threadpool_info, threadpool_limits

from cucumbervision.capture.frames import Capture
from cucumbervision.capture.intrinsics import Intrinsics
from cucumbervision.fruit.instance import Instance
from cucumbervision.methods.result import LengthKind, Measurement
from cucumbervision.methods.selector import measure_fruit
from cucumbervision.methods.table import Region, TableMethod
from cucumbervision.tube import compiled as tube_kernel
from cucumbervision.tube.compiled import OneThread
from cucumbervision.tube.evidence import SHAPE, Evidence
from cucumbervision.tube.fit import fit_shape, guess_shape
from cucumbervision.tube.shape import TubeShape

needs_kernel = pytest.mark.skipif(
    tube_kernel.library() is None, reason="the kernel is not compiled here"
)
RNG = np.random.default_rng(11)


@contextmanager
def numpy_alone() -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(tube_kernel, "library", lambda: None)
        yield


@pytest.fixture
def evidence() -> Evidence:
    """Rough readings of a body, some far off it, with seven waves of noise."""
    points, rays = surface(), tangent_rays()
    points = points * (1 + 2e-3 * RNG.standard_normal((len(points), 1)))
    points[::17] *= 1.3
    rays = rays + 1e-3 * RNG.standard_normal(rays.shape)
    rays /= np.linalg.norm(rays, axis=1)[:, None]
    waves = 1e-3 * RNG.standard_normal((len(points), 7))
    sd = RNG.uniform(5e-4, 2e-3, len(points))
    return Evidence(points, sd, rays, 7e-4, 1e-3, 0.5, 0.5, waves)


@pytest.fixture
def guess() -> TubeShape:
    body = guess_shape(surface())
    width = body.width_m * RNG.uniform(0.8, 1.2, len(body.width_m))
    return TubeShape(body.bend_m + 3e-3 * RNG.standard_normal(body.bend_m.shape), width)


def assert_close(ours: object, theirs: object) -> None:
    np.testing.assert_allclose(ours, theirs, rtol=1e-9, atol=1e-12)  # type: ignore[call-overload]


@needs_kernel
def test_a_whole_fit(evidence: Evidence) -> None:
    for seen in (evidence, replace(evidence, waves_m=None), replace(evidence, points_share=1.0)):
        body = guess_shape(surface())
        compiled = fit_shape(seen, body)
        with numpy_alone():
            by_numpy = fit_shape(seen, body)
        assert_close(compiled.shape.bend_m, by_numpy.shape.bend_m)
        assert_close(compiled.shape.width_m, by_numpy.shape.width_m)
        assert_close(compiled.centreline_sd_m, by_numpy.centreline_sd_m)
        assert_close(compiled.ends_covariance, by_numpy.ends_covariance)
        assert compiled.misfit == pytest.approx(by_numpy.misfit, rel=1e-9)
        assert compiled.ends_seen == by_numpy.ends_seen
        assert_close(compiled.points.gap_m, by_numpy.points.gap_m)
        assert_close(compiled.rays.gap_m, by_numpy.rays.gap_m)


@needs_kernel
def test_what_is_odd_is_left_to_numpy(evidence: Evidence, guess: TubeShape) -> None:
    fitted = tube_kernel.fitted
    assert fitted(evidence, guess) is not None
    for name in ("points_m", "points_sd_m", "rays", "waves_m"):
        array = getattr(evidence, name).copy()
        array.flat[5] = np.nan
        assert fitted(replace(evidence, **{name: array}), guess) is None
    assert fitted(evidence, replace(guess, width_m=np.full(SHAPE - 21, np.inf))) is None
    none = Evidence(
        np.empty((0, 3)), np.empty(0), np.empty((0, 3)), 7e-4, 1e-3, 0.5, 0.5, np.zeros((0, 0))
    )
    assert fitted(none, guess) is None
    many = replace(evidence, waves_m=np.zeros((len(evidence.points_m), 1001)))
    assert fitted(many, guess) is None
    # A body without length has no equations.
    assert fitted(evidence, replace(guess, bend_m=np.full_like(guess.bend_m, 0.5))) is None


@needs_kernel
def test_arrays_that_do_not_fit_together_never_reach_it(
    evidence: Evidence, guess: TubeShape
) -> None:
    wrong: dict[str, Any] = {
        "points_sd_m": np.ones(3),
        "waves_m": np.ones((3, 7)),
        "rays": np.ones((4, 2)),
    }
    for name, array in wrong.items():
        with pytest.raises(ValueError, match="reshape"):
            tube_kernel.fitted(replace(evidence, **{name: array}), guess)


@needs_kernel
def test_a_library_of_other_sources_or_a_damaged_one_is_not_loaded(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    load = tube_kernel.library.__wrapped__
    folder = tmp_path / "kernel"
    shutil.copytree(tube_kernel.FOLDER, folder)
    monkeypatch.setattr(tube_kernel, "FOLDER", folder)
    assert load() is not None
    header, library = folder / "kernel.h", folder / "kernel.so"
    source, whole = header.read_bytes(), library.read_bytes()
    header.write_bytes(source + b"\n")
    assert load() is None
    header.write_bytes(source)
    # Loading some of these would end the process.
    damaged = bytearray(whole)
    damaged[len(whole) // 2] ^= 4
    for content in (b"no library", whole[: len(whole) // 2], damaged, whole + b"\0"):
        library.unlink()  # it is in use: never written over
        library.write_bytes(content)
        assert load() is None
    library.unlink()
    assert load() is None
    library.write_bytes(whole)
    assert load() is not None
    library.with_suffix(".sha256").write_bytes(b"\xff")
    assert load() is None
    library.with_suffix(".sha256").unlink()
    assert load() is None


def test_numpy_is_taken_where_it_is_asked_for(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("CUCUMBERVISION_KERNEL", "numpy")
    assert tube_kernel.library.__wrapped__() is None
    monkeypatch.setattr(tube_kernel, "library", lambda: None)
    assert tube_kernel.kernel_name() == "numpy"


Seen = list[set[int]]


@pytest.fixture(scope="module")
def process() -> Iterator[ProcessPoolExecutor]:
    """A process of its own: the limit is the process's, and another test's threads may measure."""
    spawn = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(1, mp_context=spawn) as pool:
        yield pool


def blas_threads() -> set[int]:
    return {one["num_threads"] for one in threadpool_info() if one["user_api"] == "blas"}


def with_three_threads(seen: Callable[[], Seen]) -> Seen:
    """Return what a function saw where the user set three threads, and what is set after it."""
    with threadpool_limits(3, user_api="blas"):
        return [*seen(), blas_threads()]


class Observer:
    """A method of one's own that looks at the threads."""

    name, title, kind = "observer", "looks at the threads", LengthKind.BOX_CHORD

    def __init__(self) -> None:
        self.during: Seen = []

    def measure(self, region: Region) -> Measurement:
        self.during.append(blas_threads())
        return TableMethod.of("M2").measure(region)


def while_a_fruit_is_measured() -> Seen:
    observer = Observer()
    lens = Intrinsics(640, 480, 600.0, 600.0, 320.0, 240.0)
    depth = np.full((480, 640), 0.6, np.float32)
    capture = Capture(np.zeros((480, 640, 3), np.uint8), depth, lens, "a")
    box = np.array([219.5, 229.5, 419.5, 249.5])
    fruit = measure_fruit(capture, Instance(box), ("M2", observer))
    assert fruit.length is not None
    return observer.during


def after_the_first_of_two_blocks() -> Seen:
    # As of two threads of a program, of which the first to begin is the first to end.
    first, second = OneThread(), OneThread()
    first.__enter__()
    second.__enter__()
    first.__exit__()
    between = blas_threads()
    second.__exit__()
    return [between]


def while_an_error_is_raised() -> Seen:
    with pytest.raises(np.linalg.LinAlgError), OneThread():
        np.linalg.inv(np.zeros((2, 2)))
    return []


@pytest.mark.parametrize(
    ("seen", "expected"),
    [
        (while_a_fruit_is_measured, [{1}]),
        (after_the_first_of_two_blocks, [{1}]),
        (while_an_error_is_raised, []),
    ],
)
def test_one_thread_inside_and_the_users_setting_after_it(
    process: ProcessPoolExecutor, seen: Callable[[], Seen], expected: Seen
) -> None:
    assert process.submit(with_three_threads, seen).result(timeout=120) == [*expected, {3}]
