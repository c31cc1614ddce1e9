"""Methods: one file each, one signature for all, ``(scan, options, rt, seed, report) → Reconstruction``.

They are imported when they are used, so that commands without a reconstruction do not wait for them."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
