"""A greenhouse on top of `cucumbervision`: rounds, their store, the forecast, files and pages.

The public names, which `__init__.pyi` lists; each is loaded when it is first used.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
