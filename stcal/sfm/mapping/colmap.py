"""COLMAP's bindings, imported only here. They install signal handlers; the system's own are restored, of every signal
and in any thread: Python knows only some of them."""

import ctypes
import os
import signal

_ROOM = 1024  # more bytes than the system's struct sigaction has anywhere
_handlers: dict[int, ctypes.Array] = {}
if os.name == "posix":
    _system = ctypes.CDLL(None)
    # They wait until the import ends: NumPy, which it may load, would make another error of an interrupt.
    _blocked = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT, signal.SIGTERM})
    for _number in signal.valid_signals():
        _before = ctypes.create_string_buffer(_ROOM)
        if _system.sigaction(int(_number), None, _before) == 0:
            _handlers[int(_number)] = _before
try:
    import pycolmap
finally:
    if os.name == "posix":
        for _number, _before in _handlers.items():
            _system.sigaction(_number, _before, None)
        signal.pthread_sigmask(signal.SIG_SETMASK, _blocked)

__all__ = ["pycolmap"]
