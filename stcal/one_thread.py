"""Limits the libraries that this process loads from now on to one thread each, and lets them take their memory.

The server of processes imports this first; see :mod:`stcal.parallel`.
"""

import os

from stcal.parallel import ONE_THREAD, reserve_buffers

os.environ.update(dict.fromkeys(ONE_THREAD, "1"))
reserve_buffers()
