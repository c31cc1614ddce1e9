"""Shows a reconstruction to people: as a page, a picture or a window."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
