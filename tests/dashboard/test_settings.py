from __future__ import annotations

from pathlib import Path

from cucumbervision.dashboard.settings import Settings, read_settings, write_settings
from cucumbervision.perception.registry import Registry, load_registry


def test_a_broken_file_gives_the_defaults(tmp_path: Path) -> None:
    path = tmp_path / "a.json"
    path.write_text('{"unit": "furlong"}')
    assert read_settings(path) == Settings()


def test_settings_are_kept(tmp_path: Path) -> None:
    chosen = Settings(unit="in", burst=7, fruit_per_crate=20)
    write_settings(chosen, tmp_path / "deep" / "a.json")
    assert read_settings(tmp_path / "deep" / "a.json") == chosen


def test_the_detector_is_taken_as_soon_as_there_is_one() -> None:
    registry = load_registry()
    without = Registry(
        tuple(m for m in registry.models if m.task != "segment"), registry.embedded, registry.user
    )
    assert Settings().options(without).instances == "auto"
    own = registry.default("segment")
    assert Settings().options(registry).instances == ("auto" if own is None else "models")
    assert Settings(fruit_from="models").options(without).instances == "models"
    assert Settings(confidence=0.4).options(without).confidence == 0.4
