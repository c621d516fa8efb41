"""The script that Streamlit runs for every viewer: the pages and what frames them."""

from __future__ import annotations

import streamlit as st

from cucumbervision.dashboard import page_elements, resources
from cucumbervision.dashboard.access import require_login
from cucumbervision.dashboard.pages import (
    accuracy,
    capture,
    forecast,
    results,
    row_map,
    settings,
    upload,
)
from cucumbervision.errors import CucumberVisionError

__all__ = ["main"]


def main() -> None:
    """Draw the page that the viewer chose."""
    st.set_page_config(page_title="CucumberVision", page_icon="🥒", layout="wide")
    page_elements.style()
    try:
        require_login(st.get_option("server.address") or "")
    except CucumberVisionError as error:
        st.error(str(error), icon=":material/lock:")
        st.stop()
    page_elements.keep_inputs()
    chosen = st.navigation(
        [
            st.Page(
                capture.page, title="Capture", icon=":material/photo_camera:", url_path="capture"
            ),
            st.Page(upload.page, title="Upload", icon=":material/upload:", url_path="upload"),
            st.Page(
                results.page,
                title="Results",
                icon=":material/straighten:",
                url_path="results",
                default=True,
            ),
            st.Page(row_map.page, title="Row map", icon=":material/map:", url_path="map"),
            st.Page(
                forecast.page,
                title="Forecast",
                icon=":material/calendar_month:",
                url_path="forecast",
            ),
            st.Page(accuracy.page, title="Accuracy", icon=":material/target:", url_path="accuracy"),
            st.Page(
                settings.page, title="Settings", icon=":material/settings:", url_path="settings"
            ),
        ],
        position="top",
    )
    try:
        page_elements.progress(resources.prepare())
        chosen.run()
    except CucumberVisionError as error:
        st.error(str(error), icon=":material/error:")
    page_elements.footer()


if __name__ == "__main__":
    main()
