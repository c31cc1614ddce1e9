"""How thoroughly the tests try: ``make stress`` sets the environment variable STRESS."""

import os

TIMES = int(os.environ.get("STRESS", "1"))
STRESSED = TIMES > 1
