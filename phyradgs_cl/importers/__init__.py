"""Reads scans and volumes of other programs, checks them and converts them to this package's conventions.

Call ``import_scan`` for a scan and ``load_volume`` for a volume. A module in formats/ reads one or two formats of scans."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
