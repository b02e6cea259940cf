"""Images in memory, which are used as files are."""

from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import cv2
import numpy as np

from stcal.errors import InputError
from stcal.io.images import ImageFile, ImageFiles, grey_of, name_fault, without_excluded


def files_of_arrays(images: Mapping[str, Sequence[np.ndarray]], exclude: Sequence[str] = ()) -> ImageFiles:
    """Return images in memory as files that carry their content, named ``12/0.png``, ``12/1.png`` … by group.

    ``images`` : grey or RGB arrays of 8 or 16 bit, by name of the group; ``exclude`` : names of images that are not
    used.

    Raises InputError: no image, an array that is none, or a name that leads out of a folder; and as for
    :func:`stcal.io.images.chosen_images`.
    """
    named = [(group, f"{group}/{k}.png", image) for group, arrays in images.items() for k, image in enumerate(arrays)]
    if not named:
        raise InputError("E-IMAGES-NONE", "images: no image in memory; give arrays by the name of their group")
    for group, name, _ in named:
        if fault := name_fault(name) or ("is no name of one folder" if "/" in group or not group else None):
            raise InputError("E-IMAGES-GROUP", f"images: group {group!r} {fault}; give a plain name, such as 12")

    def file(group: str, name: str, image: np.ndarray) -> ImageFile:
        content = cv2.imencode(".png", grey_of(image, name), [cv2.IMWRITE_PNG_COMPRESSION, 1])[1].tobytes()
        return ImageFile(Path(name), name, group, content)

    with ThreadPoolExecutor() as pool:  # encoding releases the interpreter
        files = list(pool.map(file, *zip(*named, strict=True)))
    return without_excluded(files, [], exclude, "memory")
