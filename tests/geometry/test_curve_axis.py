from __future__ import annotations

import numpy as np
import pytest

from cucumbervision.geometry.curve import align_near, bin_centroids, depth_gate, principal_axis


def test_principal_axis_is_the_first_right_singular_vector() -> None:
    rng = np.random.default_rng(4)
    cloud = rng.normal(0, (0.1, 0.02, 0.01), (500, 3)) @ np.linalg.qr(rng.normal(size=(3, 3)))[0]
    centroid, axis = principal_axis(cloud)
    first = np.linalg.svd(cloud - cloud.mean(axis=0), full_matrices=False)[2][0]
    assert abs(float(axis @ first)) == pytest.approx(1.0, abs=1e-12)
    assert centroid == pytest.approx(cloud.mean(axis=0))


def test_one_point_has_no_axis() -> None:
    with pytest.raises(ValueError, match="1 points have no axis"):
        principal_axis(np.zeros((1, 3)))


def test_the_gate_keeps_its_own_border() -> None:
    z = np.array([0.25, 0.5, 0.75])
    points = np.stack([z, z, z], axis=1)
    assert depth_gate(points, 0.25)[:, 2].tolist() == [0.25, 0.5, 0.75]
    assert depth_gate(points, 0.2499)[:, 2].tolist() == [0.5]


def test_an_empty_cloud_stays_empty() -> None:
    assert depth_gate(np.empty((0, 3)), 0.035).shape == (0, 3)


def test_bins_with_too_few_points_are_skipped() -> None:
    x = np.array([0.0, 0.1, 0.2, 5.0, 9.8, 9.9, 10.0])
    points = np.stack([x, 2 * x, 0 * x], axis=1)
    centroids = bin_centroids(points, x, bins=5, at_least=3)
    assert centroids == pytest.approx(np.array([[0.1, 0.2, 0.0], [9.9, 19.8, 0.0]]))


def test_points_at_one_place_have_no_bins() -> None:
    points = np.ones((9, 3))
    assert bin_centroids(points, np.zeros(9), bins=5, at_least=1).shape == (0, 3)


def test_positions_are_measured_from_the_centroid() -> None:
    cloud = align_near(np.array([[1.0, 0.0, 0.5], [2.0, 0.0, 0.5], [6.0, 0.0, 0.5]]), 0.1)
    assert cloud.along_m == pytest.approx([-2.0, -1.0, 3.0])
