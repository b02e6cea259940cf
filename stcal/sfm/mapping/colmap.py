"""COLMAP's bindings, imported only here. They install signal handlers; this module restores the previous ones."""

import signal
import threading

_before = signal.getsignal(signal.SIGTERM)
_masks = hasattr(signal, "pthread_sigmask")
if _masks:  # a signal waits until the import ends: their handler would print a C stack and abort
    _blocked = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGTERM})
try:
    import pycolmap
finally:
    if threading.current_thread() is threading.main_thread():
        # Python does not know that the system's handler changed, so its own has to be set again.
        signal.signal(signal.SIGTERM, _before if _before is not None else signal.SIG_DFL)
    if _masks:
        signal.pthread_sigmask(signal.SIG_SETMASK, _blocked)

__all__ = ["pycolmap"]
