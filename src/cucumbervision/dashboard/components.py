"""Two components of our own: a picture with layers, ruler and pointer, and a cloud to be turned.

Streamlit's own picture takes no clicks, and its 3D charts need a graphics chip that a cheap
tablet has not; both are drawn on plain canvas and SVG here. Nothing is loaded from elsewhere.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import streamlit as st

__all__ = ["cloud", "picture"]

_FILES = Path(__file__).with_name("static")


def _component(name: str) -> Any:
    def text(suffix: str) -> str:
        return (_FILES / f"{name}.{suffix}").read_text(encoding="utf-8")

    return st.components.v2.component(
        f"cucumbervision_{name}", html=text("html"), css=text("css"), js=text("js")
    )


@st.cache_resource(show_spinner=False)
def _components() -> dict[str, Any]:
    return {name: _component(name) for name in ("picture", "cloud")}


def picture(
    key: str,
    images: dict[str, str],
    size_px: tuple[int, int],
    *,
    layers: list[dict[str, Any]] | None = None,
    bar: dict[str, Any] | None = None,
    tools: tuple[str, ...] = (),
    ruler_text: str = "",
    title: str = "",
) -> Any:
    """Show a picture.

    Parameters
    ----------
    key : str
        Its own.
    images : dict of str to str
        Data URLs by name; more than one can be switched.
    size_px : tuple of int
        Width and height that points are given in.
    layers : list of dict
        As `picture.fruit_layers` gives them; can be switched.
    bar : dict
        As `picture.scale_bar` gives it.
    tools : tuple of str
        Of 'ruler', 'point' and 'box'.
    ruler_text : str
        What is written on the ruler.
    title : str
        What the picture shows, for those who cannot see it.

    Returns
    -------
    ComponentResult
        `ruler`, `point` and `box`: the numbers that were drawn, once.
    """
    width, height = size_px
    data = {
        "images": images,
        "width": width,
        "height": height,
        "layers": layers or [],
        "bar": bar,
        "tools": list(tools),
        "rulerText": ruler_text,
        "title": title,
    }
    return _components()["picture"](
        key=key,
        data=data,
        on_ruler_change=_nothing,
        on_point_change=_nothing,
        on_box_change=_nothing,
    )


def cloud(key: str, data: dict[str, Any]) -> None:
    """Show a cloud as `cloud.fruit_cloud` gives it."""
    _components()["cloud"](key=key, data=data)


def _nothing() -> None:
    """Take part in no callback: the page reads the value itself."""
