"""COLMAP's bindings, imported here alone: they take the signals of a process, which stay as they were."""

import signal
import threading

_before = signal.getsignal(signal.SIGTERM)
_masks = hasattr(signal, "pthread_sigmask")
if _masks:  # a signal meanwhile waits, as their handler would print a stack of C functions and abort
    _blocked = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGTERM})
try:
    import pycolmap
finally:
    if threading.current_thread() is threading.main_thread():
        # Python's own has to be set anew, as the system's is hidden from it.
        signal.signal(signal.SIGTERM, _before if _before is not None else signal.SIG_DFL)
    if _masks:
        signal.pthread_sigmask(signal.SIG_SETMASK, _blocked)

__all__ = ["pycolmap"]
