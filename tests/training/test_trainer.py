import math
from typing import Any

import pytest

torch = pytest.importorskip("torch")
pytest.importorskip("ultralytics")

from cucumbervision.training.export_yolo import import_ultralytics  # noqa: E402
from cucumbervision.training.trainer import learn_to_see  # noqa: E402

pytestmark = pytest.mark.train


@pytest.fixture(scope="module")
def losses() -> list[Any]:
    ultralytics = import_ultralytics()
    model = ultralytics.YOLO("yolo26n-pose.yaml").model
    model.args = ultralytics.utils.DEFAULT_CFG
    learn_to_see(model)
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
