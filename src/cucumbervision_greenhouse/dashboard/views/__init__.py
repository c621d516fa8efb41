"""One page of the dashboard a file; each has a function `page` that draws it.

Not called `pages`: Streamlit would serve the files of such a folder by themselves, past the login.
"""
