"""Scripts of the repository, as modules."""

import importlib.util
import os
import sys
from pathlib import Path
from types import ModuleType

SCRIPTS = Path(__file__).resolve().parents[1] / "scripts"


def load_script(name: str) -> ModuleType:
    """``scripts/name.py``, its main function not run."""
    environment = dict(os.environ)  # studies keep numpy to one thread
    sys.path.insert(0, str(SCRIPTS))  # scripts share a module of their own
    try:
        spec = importlib.util.spec_from_file_location(name, SCRIPTS / f"{name}.py")
        module = importlib.util.module_from_spec(spec)
        sys.modules[name] = module
        spec.loader.exec_module(module)
        return module
    finally:
        sys.path.remove(str(SCRIPTS))
        os.environ.clear()
        os.environ.update(environment)
