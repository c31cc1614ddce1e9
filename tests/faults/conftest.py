"""The fixtures of faults_kit, which tests import by this name."""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parent))

from faults_kit import copies, launches, run, scan  # noqa: E402

__all__ = ["copies", "launches", "run", "scan"]
