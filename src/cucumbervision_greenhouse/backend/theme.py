"""Font and colours of all pages, light and dark: for Streamlit, and as a style sheet."""

from __future__ import annotations

import re
from functools import lru_cache
from pathlib import Path

# Text has a contrast of 7 to 1 or more, so that it is read in the sun too; words on the accent 4.5.
_COLORS = {
    "light": {
        "primaryColor": "#146432",
        "backgroundColor": "#FFFFFF",
        "secondaryBackgroundColor": "#EDF2EE",
        "textColor": "#15191C",
        "linkColor": "#146432",
        "borderColor": "#8A918C",
        "grayTextColor": "#4A525B",
        "redBackgroundColor": "#FDE7E4",
        "redTextColor": "#7A1710",
        "yellowBackgroundColor": "#FFF3CF",
        "yellowTextColor": "#533F00",
        "blueBackgroundColor": "#E5EEF9",
        "blueTextColor": "#14375E",
        "greenBackgroundColor": "#E4F2E7",
        "greenTextColor": "#0F4A26",
    },
    "dark": {
        "primaryColor": "#2A8245",
        "backgroundColor": "#121614",
        "secondaryBackgroundColor": "#1E2521",
        "textColor": "#F1F4F2",
        "linkColor": "#8ADBA3",
        "borderColor": "#7C8780",
        "grayTextColor": "#B9C3BC",
        "redBackgroundColor": "#3F1E1B",
        "redTextColor": "#FFC9C2",
        "yellowBackgroundColor": "#362B0E",
        "yellowTextColor": "#FFE08A",
        "blueBackgroundColor": "#172A3E",
        "blueTextColor": "#BFDCFF",
        "greenBackgroundColor": "#14301F",
        "greenTextColor": "#A9E8BC",
    },
}
_FONT = "Source Sans"  # comes with Streamlit
_STYLE = Path(__file__).with_name("static") / "theme.css"


def streamlit_options() -> dict[str, str | int]:
    """Return Streamlit's options for both themes.

    Examples
    --------
    >>> streamlit_options()["theme.dark.textColor"]
    '#F1F4F2'
    """
    shared: dict[str, str | int] = {
        "theme.font": _FONT,
        "theme.baseFontSize": 17,
        "theme.baseRadius": "8px",
        "theme.headingFontSizes": "2rem,1.5rem,1.25rem,1.1rem,1rem,1rem",
    }
    colors = {
        f"theme.{theme}.{name}": color
        for theme, of_theme in _COLORS.items()
        for name, color in of_theme.items()
    }
    return {**shared, **colors}


def ink(theme: str | None) -> str:
    """Return the colour of text, and of lines in charts, in 'light' or 'dark' (None is light).

    Examples
    --------
    >>> ink("dark"), ink(None)
    ('#F1F4F2', '#15191C')
    """
    return _COLORS[theme or "light"]["textColor"]


@lru_cache(maxsize=1)
def style_sheet() -> str:
    """Return the style sheet of every page: the colours by the names that Streamlit gives them.

    The device's choice of light or dark holds unless the page's head was told another one.

    Examples
    --------
    >>> style_sheet()[:57]
    ':root { color-scheme: light; --st-primary-color: #146432;'
    """
    light, dark = (
        f"color-scheme: {theme}; "
        + " ".join(f"--st-{_css_name(name)}: {color};" for name, color in of_theme.items())
        for theme, of_theme in _COLORS.items()
    )
    font = f'--st-font: "{_FONT}", system-ui, sans-serif; --st-base-radius: 8px;'
    rules = [
        f":root {{ {light} {font} }}",
        "@media screen and (prefers-color-scheme: dark) {",
        f"  :root:not([data-theme='light']) {{ {dark} }} }}",
        f"@media screen {{ :root[data-theme='dark'] {{ {dark} }} }}",
        _STYLE.read_text(encoding="utf-8"),
    ]
    return "\n".join(rules)


def font_file() -> Path:
    """Return the file of the font.

    Examples
    --------
    >>> font_file().suffix
    '.woff2'
    """
    import streamlit

    media = Path(streamlit.__file__).parent / "static/static/media"
    return next(media.glob("SourceSansVF-Upright*.woff2"))


def _css_name(option: str) -> str:
    return re.sub("([A-Z])", r"-\1", option).lower()
