"""Scripts of the repository, as modules."""

import importlib.util
import os
import sys
from pathlib import Path
from types import ModuleType

SCRIPTS = Path(__file__).resolve().parents[1] / "scripts"


def script_path(name: str) -> Path:
    """``name.py``, in whatever folder of ``scripts/`` it is."""
    (found,) = SCRIPTS.rglob(f"{name}.py")
    return found


def load_script(name: str) -> ModuleType:
    """``name.py``, its main function not run."""
    environment = dict(os.environ)  # studies keep numpy to one thread
    try:
        spec = importlib.util.spec_from_file_location(name, script_path(name))
        module = importlib.util.module_from_spec(spec)
        sys.modules[name] = module
        spec.loader.exec_module(module)
        return module
    finally:
        os.environ.clear()
        os.environ.update(environment)
