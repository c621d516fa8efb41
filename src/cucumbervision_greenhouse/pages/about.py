"""About: what the program is, its licence and where its source is."""

from __future__ import annotations

import streamlit as st

from cucumbervision._version import __version__
from cucumbervision.about import LICENCE, installed_versions, source_offer
from cucumbervision_greenhouse.core_words import words_of
from cucumbervision_greenhouse.language import gettext as _
from cucumbervision_greenhouse.language import plain
from cucumbervision_greenhouse.pages import page_elements


def page() -> None:
    """Draw the page: the offer of the source that the AGPL-3.0, section 13, asks for."""
    offer = source_offer()
    st.header(_("About"))
    words = _(
        "CucumberVision {version} measures greenhouse cucumbers. Its licence is {licence}: "
        "everyone who uses it over a network may have its source."
    )
    st.write(words.format(version=__version__, licence=LICENCE))
    if offer.startswith("http"):
        st.link_button(_("Source code"), offer, icon=":material/code:")
    else:
        st.write(_("Source code: {offer}").format(offer=plain(words_of(offer))))
    with st.expander(_("Details"), icon=":material/list:"):
        lines = [
            {_("Package"): name, _("Version"): version}
            for name, version in installed_versions().items()
        ]
        page_elements.table(lines)
