from __future__ import annotations

import json
import math
from pathlib import Path

from cucumbervision_lab.train.export import ModelCard, card_markdown, write_card


def test_a_card_is_a_page_and_a_record_without_what_could_not_be_judged(tmp_path: Path) -> None:
    card = ModelCard(
        "c-seg", "segment", "c-seg.onnx", "ab", 5, "cd",
        metrics={"sure": 0.0, "right of these": math.nan}, data="# Data\n\nten",
    )  # fmt: skip
    page, record = write_card(card, tmp_path)
    assert json.loads(record.read_text())["metrics"] == {"sure": 0.0}
    assert "right of these" not in page.read_text()
    assert page.read_text().endswith("## Data\n\nten\n")
    assert "Network and its first weights: Ultralytics YOLO26, AGPL-3.0" in card_markdown(card)
