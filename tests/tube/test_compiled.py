"""The compiled functions against NumPy's, to rounding: the latter have tests of their own."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from tests.tube.test_fit import surface, tangent_rays

from cucumbervision.tube import compiled as tube_kernel
from cucumbervision.tube.compiled import Contacts, Fit, call
from cucumbervision.tube.evidence import (
    BODY,
    SHAPE,
    Evidence,
    Gaps,
    depth_gaps,
    ends_seen,
    gaps,
    gaps_of,
    normal_equations,
    point_readings,
    ray_readings,
)
from cucumbervision.tube.fit import (
    add_nuisance_prior,
    add_shape_prior,
    end_hold,
    fit_shape,
    guess_shape,
    solve_held,
    stepped,
)
from cucumbervision.tube.pixels import median_of
from cucumbervision.tube.shape import TubeShape

needs_kernel = pytest.mark.skipif(
    tube_kernel.library() is None, reason="the kernel is not compiled here"
)
RNG = np.random.default_rng(11)
HOLD = np.array([1.5, 0.15])


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


@pytest.fixture
def nuisance(evidence: Evidence) -> NDArray[np.float64]:
    return 1e-3 * RNG.standard_normal(3 + evidence.waves)


@pytest.fixture
def fit(evidence: Evidence, guess: TubeShape, nuisance: NDArray[np.float64]) -> Fit:
    """A compiled fit whose readings are measured already."""
    fit = Fit(evidence, guess)
    fit.nuisance[:] = nuisance
    call("point_readings", fit.bases, fit.seen, fit.shape, fit.nuisance, fit.readings[0])
    call("ray_readings", fit.bases, fit.seen, fit.shape, fit.nuisance, fit.readings[1])
    return fit


def assert_close(ours: object, theirs: object) -> None:
    np.testing.assert_allclose(ours, theirs, rtol=1e-9, atol=1e-12)  # type: ignore[call-overload]


def assert_same(ours: Gaps, theirs: Gaps) -> None:
    for name in Gaps.__dataclass_fields__:
        assert_close(getattr(ours, name), getattr(theirs, name))


def lower(fit: Fit) -> NDArray[np.float64]:
    size = fit.sums.size
    return np.tril(fit.normal[:size, :size])


@needs_kernel
@pytest.mark.parametrize("count", [0, 1, 63, 65, 150])
def test_gaps_of_points_and_rays(count: int, guess: TubeShape) -> None:
    points = surface()[RNG.integers(0, 600, count)] * RNG.uniform(0.9, 1.2, (count, 1))
    rays = points / np.linalg.norm(points, axis=1)[:, None]
    far = np.linalg.norm(points, axis=1)
    aside = rays + np.array([0.3, 0.0, 0.0])  # beside the body
    for readings, is_rays in ((points, False), (rays, True), (aside, True)):
        compiled = gaps(guess, readings, rays=is_rays)
        with numpy_alone():
            assert_same(compiled, gaps(guess, readings, rays=is_rays))
    for readings in (rays, aside):
        contacts, facing = depth_gaps(guess, readings, far)
        with numpy_alone():
            by_numpy, facing_by_numpy = depth_gaps(guess, readings, far)
        assert_same(contacts, by_numpy)
        assert_close(facing, facing_by_numpy)


@needs_kernel
def test_every_position_along_the_curve_has_its_four_control_points(fit: Fit) -> None:
    # At every third of the widths' segments begins one of the curve's.
    bend, width = (fit.bases.arrays[k].reshape(1025, -1) for k in (2, 3))
    for index in range(1025):
        segment = min(index * 12 // 1024, 11)
        assert bend[index, segment // 3 : segment // 3 + 4].sum() == pytest.approx(1)
        assert width[index, segment : segment + 4].sum() == pytest.approx(1)


@needs_kernel
def test_readings(
    fit: Fit, evidence: Evidence, guess: TubeShape, nuisance: NDArray[np.float64]
) -> None:
    with numpy_alone():
        points = point_readings(evidence, guess, nuisance)
        rays = ray_readings(evidence, guess, nuisance[:3])
    for compiled, by_numpy in ((fit.points, points), (fit.rays, rays)):
        assert_same(gaps_of(compiled), by_numpy.contacts)
        assert_close(compiled.sd_m, by_numpy.sd_m)


@needs_kernel
@pytest.mark.parametrize("scale", [1.0, 16.0])
def test_normal_equations_with_their_priors(
    scale: float, fit: Fit, evidence: Evidence, guess: TubeShape, nuisance: NDArray[np.float64]
) -> None:
    with numpy_alone():
        points = point_readings(evidence, guess, nuisance)
        rays = ray_readings(evidence, guess, nuisance[:3])
    scatter = np.array([0.8, 1.7])
    normal, target = normal_equations((points, rays), (0.5, 0.5), (0.8, 1.7), scale)
    call("normal_equations", fit.bases, fit.seen, *fit.readings, scatter, scale, fit.sums)
    largest = np.abs(normal).max()
    assert_close(lower(fit) / largest, np.tril(normal) / largest)
    assert_close(fit.target[: len(target)], target)
    anchors = guess.balls(2)[0].copy()
    add_shape_prior(normal, target, guess, anchors + 0.01, HOLD)
    add_nuisance_prior(normal, target, nuisance, evidence)
    call("add_shape_prior", fit.bases, fit.shape, anchors + 0.01, HOLD, fit.sums)
    call("add_nuisance_prior", fit.seen, fit.nuisance, fit.sums)
    assert_close(lower(fit) / largest, np.tril(normal) / largest)
    assert_close(fit.target[: len(target)] / largest, target / largest)
    move = solve_held(normal, target, BODY)
    assert call("solve_held", fit.sums) == 1
    np.testing.assert_allclose(fit.target[: len(move)], move, rtol=1e-6, atol=1e-9)
    after, taken = stepped(guess, move, BODY)
    call("stepped", fit.shape, fit.target, len(move))
    np.testing.assert_allclose(fit.bend_m, after.bend_m, atol=1e-9)
    np.testing.assert_allclose(fit.width_m, after.width_m, atol=1e-9)
    np.testing.assert_allclose(fit.target[: len(move)], taken, rtol=1e-6, atol=1e-9)


@needs_kernel
def test_ends_and_how_they_are_held(fit: Fit, evidence: Evidence, guess: TubeShape) -> None:
    seen, hold = np.zeros(2, np.int64), np.zeros(2)
    given = (fit.bases, fit.shape, len(evidence.rays), evidence.rays, fit.readings[1])
    call("ends_seen", *given, seen)
    assert tuple(map(bool, seen)) == ends_seen(guess, gaps_of(fit.rays), evidence.rays)
    for visible in ((True, False), (False, True)):
        call("end_hold", np.array(visible, np.int64), hold)
        assert hold.tolist() == end_hold(visible).tolist()


@needs_kernel
@pytest.mark.parametrize("count", [1, 2, 3, 15, 500, 501])
def test_median_scatter_and_misfit(count: int) -> None:
    contacts = Contacts.empty(count)
    contacts.gap_m[:], contacts.sd_m[:] = RNG.standard_normal(count), 0.5
    contacts.gap_m[: count // 3] = 1.0  # many are alike
    sums = np.abs(contacts.gap_m / 0.5)
    scatter = call("scatter", contacts.struct, count, 0.1, 9.0)
    assert scatter == pytest.approx(min(max(1.4826 * median_of(sums), 0.1), 9.0), rel=1e-12)
    misfit = call("misfit", contacts.struct, count, 0.25)
    assert misfit == pytest.approx(0.25 * (np.minimum(sums, 5.0) ** 2).sum(), rel=1e-12)


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
    with pytest.raises(ValueError, match="reshape"):
        tube_kernel.gaps(guess, np.ones((4, 2)), rays=True)
    with pytest.raises(ValueError, match="reshape"):
        tube_kernel.depth_gaps(guess, np.ones((4, 3)), np.ones(5))


@needs_kernel
def test_other_types_and_strides_are_read_as_numpy_does(guess: TubeShape) -> None:
    points = surface()[:20]
    as_single = points.astype(np.float32)
    expected = gaps(guess, as_single.astype(np.float64), rays=False).gap_m
    assert_close(gaps(guess, as_single, rays=False).gap_m, expected)  # type: ignore[arg-type]
    every_other = gaps(guess, points[::2], rays=False).gap_m
    assert_close(every_other, gaps(guess, points, rays=False).gap_m[::2])


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
