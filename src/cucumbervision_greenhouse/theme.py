"""Font and colours of all pages, light and dark, as a style sheet beside Streamlit's own."""

from __future__ import annotations

import re
import tomllib
from functools import lru_cache
from pathlib import Path

_HERE = Path(__file__)
COLORS: dict[str, dict[str, str]] = {
    theme: colors
    for theme, colors in tomllib.loads(
        _HERE.with_name("pages").joinpath(".streamlit/config.toml").read_text(encoding="utf-8")
    )["theme"].items()
    if theme in ("light", "dark")
}
"""Colours of both themes, by Streamlit's names."""

THEME_STYLE = _HERE.with_name("static") / "theme.css"
"""Styles of parts that all pages have."""


def ink(theme: str | None) -> str:
    """Return the colour of text, and of lines in charts, in 'light' or 'dark' (None is light).

    Examples
    --------
    >>> ink("dark"), ink(None)
    ('#F1F4F2', '#15191C')
    """
    return COLORS[theme or "light"]["textColor"]


@lru_cache(maxsize=1)
def style_sheet() -> str:
    """Return the style sheet of every page: the colours by the names that Streamlit gives them.

    The device's choice of light or dark holds unless `theme.js` sets another one.

    Examples
    --------
    >>> style_sheet()[:57]
    ':root { color-scheme: light; --st-primary-color: #146432;'
    """
    light, dark = (
        f"color-scheme: {theme}; "
        + " ".join(f"--st-{_css_name(name)}: {color};" for name, color in of_theme.items())
        for theme, of_theme in COLORS.items()
    )
    font = "--st-font: system-ui, sans-serif; --st-base-radius: 8px;"
    rules = [
        f":root {{ {light} {font} }}",
        "@media screen and (prefers-color-scheme: dark) {",
        f"  :root:not([data-theme='light']) {{ {dark} }} }}",
        f"@media screen {{ :root[data-theme='dark'] {{ {dark} }} }}",
        THEME_STYLE.read_text(encoding="utf-8"),
    ]
    return "\n".join(rules)


def _css_name(option: str) -> str:
    return re.sub("([A-Z])", r"-\1", option).lower()
