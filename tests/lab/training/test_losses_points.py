import itertools
import math
from pathlib import Path
from typing import Any

import pytest

torch = pytest.importorskip("torch")
pytest.importorskip("ultralytics")

from cucumbervision_lab.training.checkpoint import import_ultralytics  # noqa: E402
from cucumbervision_lab.training.losses import (  # noqa: E402
    assign_by_boxes_and_keypoints,
    has_keypoint_head,
    keypoint_sigma_at,
    learn_visibility,
    order_by_position,
    set_keypoint_sigma,
)

pytestmark = pytest.mark.train


def network() -> Any:
    ultralytics = import_ultralytics()
    model = ultralytics.YOLO("yolo26n-pose.yaml").model
    model.args = ultralytics.utils.DEFAULT_CFG
    return model


@pytest.fixture(scope="module")
def losses() -> list[Any]:
    model = network()
    learn_visibility(model)
    return [model.criterion.one2many, model.criterion.one2one]


def judged(loss: Any, confidence: Any, visibility: Any) -> float:
    """Ask for the place and then the confidence, as Ultralytics' loss does."""
    count = visibility.shape[1]
    place = torch.zeros(*visibility.shape, 3)
    place[..., 2] = visibility
    labelled = visibility != 0
    loss.keypoint_loss(torch.zeros(len(visibility), count, 3), place, labelled, torch.ones(1, 1))
    return float(loss.bce_pose(confidence, labelled.float()))


def test_a_hidden_point_is_to_look_hidden_though_its_place_is_labelled(losses: list[Any]) -> None:
    visibility = torch.full((1, 17), 1.0)
    visibility[0, 0] = 2.0
    sure_of_the_first = torch.full((1, 17), -20.0)
    sure_of_the_first[0, 0] = 20.0
    for loss in losses:
        assert judged(loss, sure_of_the_first, visibility) == pytest.approx(0.0, abs=1e-6)
        # Unsure of all, each costs log 2.
        assert judged(loss, torch.zeros(1, 17), visibility) == pytest.approx(math.log(2), rel=1e-6)


def test_a_fruit_without_labelled_points_teaches_nothing_of_them(losses: list[Any]) -> None:
    visibility = torch.zeros(2, 17)
    visibility[1] = 2.0
    confidence = torch.full((2, 17), 20.0)
    for loss in losses:
        # The first fruit would cost 20 a point.
        assert judged(loss, confidence, visibility) == pytest.approx(0.0, abs=1e-6)
        assert judged(loss, confidence[:1], visibility[:1]) == 0.0


def test_the_tolerance_falls_to_what_is_asked_for_and_stays() -> None:
    falling = [keypoint_sigma_at(k / 20) for k in range(21)]
    assert falling[0] == pytest.approx(0.2)
    assert all(a >= b for a, b in itertools.pairwise(falling))
    assert falling[14:] == pytest.approx([0.05] * 7)


def test_tolerance_reaches_loss_and_assignment() -> None:
    model = network()
    assign_by_boxes_and_keypoints(model)
    learn_visibility(model)
    loss = model.criterion.one2one
    found, true = torch.zeros(1, 17, 3), torch.zeros(1, 17, 3)
    found[..., 0] = 1.0  # each is one pixel off, in a box of 100 square pixels
    seen = torch.ones(1, 17, dtype=torch.bool)
    for sigma in (0.2, 0.05):
        set_keypoint_sigma(model, sigma)
        expected = 1 - math.exp(-1 / (2 * 100 * (2 * sigma) ** 2))
        got = float(loss.keypoint_loss(found, true, seen, torch.full((1, 1), 100.0)))
        assert got == pytest.approx(expected, rel=1e-5)
        assert loss.assigner.sigmas.tolist() == pytest.approx([sigma] * 17)


def test_an_anchor_with_the_right_box_counts_though_its_points_are_wrong() -> None:
    model = network()
    assign_by_boxes_and_keypoints(model)
    set_keypoint_sigma(model, 0.05)
    box = torch.tensor([[[10.0, 10.0, 50.0, 30.0]]])
    found = torch.cat([box, box + 100], dim=1)  # the second is beside it
    points = torch.zeros(1, 1, 17, 3)
    points[..., 0], points[..., 1], points[..., 2] = 30.0, 20.0, 2.0
    indices = tuple(torch.tensor(v) for v in ([0, 0, 0], [0, 0, 0], [0, 1, 0]))
    far = torch.full((1, 2, 17, 2), 500.0)
    overlaps = model.criterion.one2one.assigner.pair_overlaps(indices, box, found, far, points)
    # A perfect box and hopeless points: one half. Ultralytics' own gives nothing.
    assert overlaps.tolist() == pytest.approx([0.5, 0.0, 0.5], abs=1e-4)
    near = torch.stack([torch.full((1, 2, 17), 30.0), torch.full((1, 2, 17), 20.0)], dim=-1)
    overlaps = model.criterion.one2one.assigner.pair_overlaps(indices, box, found, near, points)
    assert overlaps.tolist() == pytest.approx([1.0, 0.5, 1.0], abs=1e-4)


def test_only_a_network_of_five_points_knows_them(tmp_path: Path) -> None:
    ultralytics = import_ultralytics()
    assert not has_keypoint_head("yolo26n-pose.yaml")
    for kind, points, known in (("pose", 17, False), ("pose", 5, True), ("seg", 0, False)):
        net = ultralytics.YOLO(f"yolo26n-{kind}.yaml")
        if points == 5:
            net.model = ultralytics.nn.tasks.PoseModel(
                "yolo26n-pose.yaml", nc=1, data_kpt_shape=(5, 3), verbose=False
            )
        net.save(tmp_path / "net.pt")
        assert has_keypoint_head(str(tmp_path / "net.pt")) is known


@pytest.mark.parametrize(
    ("ahead", "turned"),
    [
        ((0.2, 0.0), False),  # to the right
        ((-0.2, 0.0), True),
        ((0.0, -0.2), False),  # upwards
        ((0.0, 0.2), True),
        ((0.1, 0.2), True),  # more down than to the right
        ((-0.2, -0.1), True),
    ],
)
def test_points_run_from_the_lower_left_to_the_upper_right(
    ahead: tuple[float, float], turned: bool
) -> None:
    points = torch.zeros(1, 5, 3)
    for axis in (0, 1):
        points[0, :, axis] = 0.5 + torch.linspace(-0.5, 0.5, 5) * ahead[axis]
    points[0, :, 2] = torch.tensor([2.0, 2.0, 1.0, 2.0, 1.0])
    expected = points.flip(1) if turned else points
    assert torch.equal(order_by_position(points, 640, 640), expected)


def test_the_pictures_shape_counts_and_points_outside_do_not() -> None:
    points = torch.zeros(2, 5, 3)
    # 0.2 of 640 px to the left is more than 0.3 of 320 px upwards: it is turned.
    points[0, :, 0] = torch.linspace(0.6, 0.4, 5)
    points[0, :, 1] = torch.linspace(0.6, 0.3, 5)
    points[0, :, 2] = 2.0
    # Of the other only the first two points are in the picture, and run down.
    points[1, :2, 0] = 0.5
    points[1, :2, 1] = torch.tensor([0.5, 0.9])
    points[1, :2, 2] = 2.0
    ordered = order_by_position(points, 640, 320)
    assert torch.equal(ordered[0], points[0].flip(0))
    assert ordered[1, :, 2].tolist() == [0.0, 0.0, 0.0, 2.0, 2.0]
    assert ordered[1, 3:, 1].tolist() == pytest.approx([0.9, 0.5])


def test_one_point_alone_says_nothing_of_the_order() -> None:
    points = torch.zeros(2, 5, 3)
    points[0, 1] = torch.tensor([0.5, 0.5, 2.0])
    assert torch.equal(order_by_position(points, 64, 64), torch.zeros(2, 5, 3))
