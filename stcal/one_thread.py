"""Limits the libraries that this process loads from now on to one thread each.

The server of processes imports this first; see :mod:`stcal.parallel`.
"""

import os

from stcal.parallel import ONE_THREAD

os.environ.update(dict.fromkeys(ONE_THREAD, "1"))
