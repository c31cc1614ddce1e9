"""The end of one rank is the end of all: others would wait for it for ever."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager

from phyradgs_cl.parallel.communicator import Communicator


@contextmanager
def failing_together(ranks: Communicator, last_words: Callable[[BaseException], int]) -> Iterator[None]:
    """An exception of the body goes on where all ranks have one; if only some do, they say why and end all.

    ``last_words`` does the saying and returns the exit status.
    """
    try:
        yield
    except BaseException as error:
        if not ranks.all_fail():
            ranks.abort(last_words(error))
        raise
