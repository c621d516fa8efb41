"""The dashboard: Streamlit pages that only call names of other rooms, and what keeps them quick."""
