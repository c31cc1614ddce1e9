"""Commands under mpiexec: one voice, and one end for all."""

import os
import sys
import traceback
from collections.abc import Sequence
from contextlib import suppress

from phyradgs_cl import signals
from phyradgs_cl.errors import PhyradgsError
from phyradgs_cl.parallel import launched

SHARING = ("reconstruct",)
"""Commands whose work ranks share; of the others rank 0 does all."""


def takes_part(arguments: Sequence[str]) -> bool:
    """Whether this process has a part in a command. Where it is not rank 0, it is silent from now on."""
    if launched().rank == 0:
        return True
    # who writes there knows that there may be nothing, as in a process of a window
    sys.stdout = sys.stderr = None
    return tuple(arguments[:1]) in {(name,) for name in SHARING}


def last_words(error: BaseException) -> int:
    """One line on stderr, whatever has become of it, by a rank that ends all; the exit status."""
    rank = launched().rank
    if isinstance(error, KeyboardInterrupt):
        text, status = signals.farewell(), signals.exit_status()
    elif isinstance(error, PhyradgsError):
        text, status = str(error), error.exit_code
    else:
        text, status = "".join(traceback.format_exception(error)), 1
    with suppress(OSError):
        os.write(2, f"phyradgs: {f'rank {rank}: ' if rank else ''}{text}\n".encode())
    return status
