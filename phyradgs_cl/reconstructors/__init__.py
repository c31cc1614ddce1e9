"""Reconstruction methods, one per file or folder. ``run.py`` runs a plan (``reconstruct``), ``method.py`` lists the methods.

Modules are imported at their first use, so that commands that do not reconstruct start sooner."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
