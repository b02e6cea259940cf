"""COLMAP's bindings, imported here alone: they take the signals of a process, which stay as they were."""

import signal
import threading

_before = signal.getsignal(signal.SIGTERM)
import pycolmap  # noqa: E402

if threading.current_thread() is threading.main_thread():
    # Its handler prints a stack of C functions; Python's own has to be set anew, as the system's is hidden from it.
    signal.signal(signal.SIGTERM, _before if _before is not None else signal.SIG_DFL)

__all__ = ["pycolmap"]
