"""Scans and volumes in other programs' formats, checked and converted to this package's conventions. `import_scan` and
`load_volume` read them; a format is a module of formats/."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
