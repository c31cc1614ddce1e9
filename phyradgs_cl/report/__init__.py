"""Shows a reconstruction: as an HTML page, a picture, or a window of napari."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
