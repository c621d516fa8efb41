"""The light page that captures rounds while walking, without Streamlit, and its routes."""
