from __future__ import annotations

import re

import pytest

from cucumbervision_greenhouse.theme import COLORS, style_sheet

THEMES = ("light", "dark")


def luminance(color: str) -> float:
    """WCAG 2.2, relative luminance."""
    shares = [int(color[k : k + 2], 16) / 255 for k in (1, 3, 5)]
    red, green, blue = (x / 12.92 if x <= 0.04045 else ((x + 0.055) / 1.055) ** 2.4 for x in shares)
    return 0.2126 * red + 0.7152 * green + 0.0722 * blue


def contrast(color: str, other: str) -> float:
    dark, light = sorted((luminance(color), luminance(other)))
    return (light + 0.05) / (dark + 0.05)


@pytest.mark.parametrize("theme", THEMES)
def test_text_is_read_in_the_sun_and_the_accent_on_its_button(theme: str) -> None:
    color = COLORS[theme]
    assert contrast("#FFFFFF", color["primaryColor"]) >= 4.5
    for name in ("text", "grayText", "link"):
        assert contrast(color[f"{name}Color"], color["backgroundColor"]) >= 7
    for hue in ("red", "yellow", "blue", "green"):
        assert contrast(color[f"{hue}TextColor"], color[f"{hue}BackgroundColor"]) >= 7


def test_the_style_sheet_has_the_colours_of_streamlit_by_its_names() -> None:
    light, dark = style_sheet().split("@media", 1)
    assert "--st-secondary-background-color: #EDF2EE;" in light
    assert "--st-secondary-background-color: #1E2521;" in dark
    assert set(re.findall(r"--st-[\w-]+-color", light)) == set(
        re.findall(r"(--st-[\w-]+-color):", dark)
    )
