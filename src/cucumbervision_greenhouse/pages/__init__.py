"""Streamlit's pages, one a file with a function `page` that draws it, and their script `app.py`."""
