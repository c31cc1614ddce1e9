"""Reads and writes files of scans, volumes and deformations, and reads descriptions of scanners. Writes a file completely
or not at all."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
