"""Rounds of a house: captures added, placed, merged, compared between days, and forecast.

`__init__.pyi` lists what the commands use; each name is loaded when it is first used.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
