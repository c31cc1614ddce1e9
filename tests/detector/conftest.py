"""The tests of SpekPy's spectrum are collected where the package is (make test-spectrum)."""

import importlib.util

collect_ignore = [] if importlib.util.find_spec("spekpy") else ["test_spekpy.py"]
