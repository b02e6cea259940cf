"""Refusal of an environment in which another distribution has written into this package.

The ``stcal`` of the package index is another project with a package of the same name. Installed beside this one, each
overwrites files of the other, and what is imported is a mixture.
"""

from pathlib import Path

OTHER = "stcal-*.dist-info"
"""What a distribution named ``stcal`` leaves beside the package."""


def fault(package: Path) -> str:
    """Returns in one line that another distribution shares the folder of the package, or an empty string."""
    for other in sorted(package.parent.glob(OTHER)):
        name, version = other.name.removesuffix(".dist-info").split("-", 1)
        return (
            f"{package}: the distribution {name} {version}, another project or an early release of this one, shares "
            "this folder; `pip uninstall stcal`, then `pip install --force-reinstall --no-deps "
            "stereo-target-calibration`, or give each its own environment"
        )
    return ""
