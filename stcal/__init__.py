"""stcal: calibration of stereo targets from photographs of a single camera, and the use of them.

See :func:`stcal.sfm.run` for the main job and ``docs/explanation/conventions.md`` for conventions. Each system is a
package, loaded when it is first used.
"""

from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING

from stcal.alone import fault

if TYPE_CHECKING:
    from stcal import handeye, locate, register, robot, sfm

if _fault := fault(Path(__file__).parent):
    raise ImportError(_fault)

__version__ = "0.1.0"
__all__ = ["handeye", "locate", "register", "robot", "sfm"]


def __getattr__(name: str):
    """Imports a system when it is first used."""
    if name not in __all__:
        raise AttributeError(f"module stcal has no attribute {name}")
    return import_module(f"stcal.{name}")


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
