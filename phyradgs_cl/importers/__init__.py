"""Reads scans and volumes in other programs' formats, checks them and converts them to this package's conventions.
`import_scan` and `load_volume` are the entries; each format of scans has a module in formats/."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
