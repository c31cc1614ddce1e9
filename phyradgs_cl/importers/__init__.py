"""Scans and volumes in other programs' formats: read, checked as if by strangers, and turned into our conventions.

`import_scan` and `load_volume` are the doors; one module per format.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
