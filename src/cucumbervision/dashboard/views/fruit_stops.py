"""One fruit's views from all stops side by side, with their lengths and that of all together."""

from __future__ import annotations

from typing import TYPE_CHECKING

import streamlit as st

from cucumbervision.dashboard import resources
from cucumbervision.dashboard.round_tables import interval_words, length_words

if TYPE_CHECKING:
    from cucumbervision.dashboard.settings import Units
    from cucumbervision.store.records import DetectionRecord
    from cucumbervision.store.views import DetectionView, RoundView

_ABREAST = 4


def show_stops(one: RoundView, fruit: DetectionView) -> None:
    """Draw the views of a fruit, the one that stands first; nothing where there is only one.

    Parameters
    ----------
    one : RoundView
        Its round.
    fruit : DetectionView
        Any of its views.
    """
    content, units = resources.content_of(one), resources.settings().units
    views = sorted((v for v in content.views if v.group == fruit.group), key=lambda v: not v.best)
    if len(views) < 2:
        return
    st.markdown(f"**Seen {len(views)} times**")
    for first in range(0, len(views), _ABREAST):
        for column, view in zip(
            st.columns(_ABREAST), views[first : first + _ABREAST], strict=False
        ):
            if (cut := resources.cutout_of(view)) is not None:
                column.image(cut, width="stretch")
            stands = " · this one stands" if view.best else ""
            column.caption(f"Stop {view.step or '?'}: {_length(view.record, units)}{stands}")
    together = next((x.view for x in resources.fruit_of(one) if x.view.group == fruit.group), None)
    if together is not None:
        st.caption(f"All that show it whole, together: {_length(together.record, units)}")


def _length(record: DetectionRecord, units: Units) -> str:
    words = length_words(record, units)
    interval = None if record.partial else interval_words(record, units)
    return f"{words} ({interval})" if interval else words
