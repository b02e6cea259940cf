"""stcal: calibration of stereo targets from photographs of a single camera, and the use of them.

See :func:`stcal.sfm.run` for the main job, ``docs/howto/python.md`` for eleven tasks, and
``docs/explanation/conventions.md`` for conventions. Names are loaded when they are first used.
"""

from pathlib import Path

import lazy_loader

from stcal.errors import fault

if _fault := fault(Path(__file__).parent):
    raise ImportError(_fault)

__version__ = "0.1.0"
__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
