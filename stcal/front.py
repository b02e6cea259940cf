"""The front of a package: its public names, each loaded when it is first used."""

import sys
from types import ModuleType

import lazy_loader


class _Front(ModuleType):
    """A package whose public functions are not hidden by folders of the same name, as ``run`` by ``run/``."""

    def __setattr__(self, name: str, value: object) -> None:
        if not (isinstance(value, ModuleType) and name in self.__all__):
            super().__setattr__(name, value)


def front(package: str, file: str) -> None:
    """Give a package the names of the ``__init__.pyi`` beside its ``__init__.py``, as ``__all__`` and as attributes.

    Parameters
    ----------
    package, file : the package's ``__name__`` and ``__file__``
    """
    module = sys.modules[package]
    names = ("__getattr__", "__dir__", "__all__")
    vars(module).update(zip(names, lazy_loader.attach_stub(package, file), strict=True))
    module.__class__ = _Front
