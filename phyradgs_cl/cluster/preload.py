"""What a local worker does first: Ctrl-C in a terminal reaches the whole group, and is the client's to answer."""

import signal
import threading


def dask_setup(worker: object) -> None:
    if threading.current_thread() is threading.main_thread():
        signal.signal(signal.SIGINT, signal.SIG_IGN)
