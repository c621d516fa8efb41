"""About: what the program is, its licence and where its source is."""

from __future__ import annotations

import streamlit as st

from cucumbervision._version import __version__
from cucumbervision.about import LICENCE, installed_versions, source_offer
from cucumbervision_greenhouse.backend.words import plain
from cucumbervision_greenhouse.dashboard import page_elements


def page() -> None:
    """Draw the page: the offer of the source that the AGPL-3.0, section 13, asks for."""
    offer = source_offer()
    st.subheader("About")
    st.write(
        f"CucumberVision {__version__} measures greenhouse cucumbers. Its licence is {LICENCE}: "
        "everyone who uses it over a network may have its source."
    )
    if offer.startswith("http"):
        st.link_button("Source code", offer, icon=":material/code:")
    else:
        st.write(f"Source code: {plain(offer)}")
    with st.expander("Details", icon=":material/list:"):
        lines = [
            {"Package": name, "Version": version} for name, version in installed_versions().items()
        ]
        page_elements.table(lines)
