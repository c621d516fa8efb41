from __future__ import annotations

import pytest

from cucumbervision_lab.cli.screen import DownloadBar


def test_the_bar_counts_as_pooch_calls_it(capsys: pytest.CaptureFixture[str]) -> None:
    bar = DownloadBar("sam-vit-b")
    bar.total = 2_000_000
    bar.update(1_500_000)
    # pooch starts over at the end and counts everything at once.
    bar.reset()
    bar.update(2_000_000)
    bar.close()
    shown = capsys.readouterr()
    assert bar.total == 2_000_000
    assert "sam-vit-b" in shown.err
    assert "2.0/2.0 MB" in shown.err
    assert shown.out == ""
