"""Methods: one file each, one signature for all, ``(scan, options, rt, seed, report) → Reconstruction``.

They are imported when they are used: a command that only holds its signals does not wait for them.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach(
    __name__,
    submod_attrs={
        "preprocess": ["InputOptions"],
        "registry": ["METHODS", "Method", "input_options", "method_name", "method_options", "reconstruct"],
        "result": ["Progress", "ProgressReport", "Reconstruction", "State", "ignore_progress"],
    },
)
