"""A stop that was asked for, by Ctrl-C or by the system: a cancellation, whatever comes of it.

Either raises KeyboardInterrupt wherever the program happens to be. Numba's compiler drops what is
raised while it calls back into Python, and fails of what it then lacks; so the wish is kept.
"""

import signal
import threading
from types import FrameType

_is_wanted = threading.Event()


def interrupt_on_stop() -> None:
    """From now on let a stop by the system leave the same resumable state as Ctrl-C."""
    _is_wanted.clear()
    signal.signal(signal.SIGTERM, _interrupt)
    # Who has it ignored, as shells do for jobs in the background, wants it ignored.
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, _interrupt)


def is_stop_wanted() -> bool:
    """Whether somebody asked for a stop, though the interrupt may have been lost."""
    return _is_wanted.is_set()


def _interrupt(signal_number: int, frame: FrameType | None) -> None:
    _is_wanted.set()
    raise KeyboardInterrupt
