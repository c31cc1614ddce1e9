"""Warnings about a file that wait until it is read: of a file that is refused, the error is all there is to say."""

import logging
from collections.abc import Iterator
from contextlib import contextmanager

_PACKAGE = "phyradgs_cl"


class _Held(logging.Handler):
    def __init__(self) -> None:
        super().__init__()
        self.records: list[logging.LogRecord] = []

    def emit(self, record: logging.LogRecord) -> None:
        self.records.append(record)


@contextmanager
def held_warnings() -> Iterator[None]:
    """What the package logs in the body is logged at its end, and not at all if the body raises an error."""
    logger, held = logging.getLogger(_PACKAGE), _Held()
    propagated, logger.propagate = logger.propagate, False
    logger.addHandler(held)
    try:
        yield
    finally:
        logger.removeHandler(held)
        logger.propagate = propagated
    for record in held.records:
        logging.getLogger(record.name).handle(record)
