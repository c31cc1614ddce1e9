"""Reads scans and volumes of other programs, checks them and converts them to this package's conventions.

Call ``import_scan`` for a scan and ``load_volume`` for a volume. Each format of scans has a module in formats/."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
