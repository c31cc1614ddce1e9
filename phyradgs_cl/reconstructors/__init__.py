"""Methods: a file or a folder each. ``run.py`` runs a plan (``reconstruct``), ``method.py`` lists the methods (``METHODS``).

Modules are imported when they are used, so that commands that do not reconstruct need not wait for them."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
