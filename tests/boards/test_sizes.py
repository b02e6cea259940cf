"""Images of a board of which one has another size, or was turned."""

import cv2
import numpy as np
import pytest
from PIL import Image

from stcal.boards.board_designs import ChessboardDesign
from stcal.io.cameras.camera_model import camera_from_opencv
from stcal.io.images import find_images
from stcal.workflows.board_views import detect_boards

BOARD = ChessboardDesign(5, 7, 20.0)
WIDTH, HEIGHT = 400, 300


def photograph() -> np.ndarray:
    squares = np.kron(np.indices((6, 8)).sum(axis=0) % 2, np.ones((30, 30))) * 180 + 40
    image = np.full((HEIGHT, WIDTH), 220.0)
    image[60:240, 80:320] = squares
    return cv2.GaussianBlur(image, (0, 0), 1.0).astype(np.uint8)


@pytest.mark.slow
@pytest.mark.parametrize("size", [(0, 0), (WIDTH, HEIGHT)])
@pytest.mark.parametrize("orientation", [1, 6])
def test_one_turned_photograph_in_front_drops_itself_alone(tmp_path, size, orientation):
    """EXIF says of 6 how to turn it back, and of 1 nothing."""
    grey = photograph()
    exif = Image.Exif()
    exif[0x0112] = orientation
    Image.fromarray(np.rot90(grey).copy()).save(tmp_path / "0.png", exif=exif)
    for i in range(1, 6):
        cv2.imwrite(str(tmp_path / f"{i}.png"), grey)
    files, _ = find_images(tmp_path)
    model = camera_from_opencv([500, 500, 199.5, 149.5], np.zeros(0), False, *size)
    found = detect_boards(files, model, BOARD, workers=1)
    turned_back = orientation == 6
    assert (found.camera.width, found.camera.height) == (WIDTH, HEIGHT)
    assert len(found.views()) == 5 + turned_back
    assert [each.name for each in found.skipped] == ([] if turned_back else ["0.png"])
    if turned_back:
        turned, upright = (found.views()[name].xy_px for name in ("0.png", "1.png"))
        # The board looks the same after half a turn, and OpenCV's detector begins at either end.
        same_end = np.linalg.norm(turned[0] - upright[0]) < np.linalg.norm(turned[0] - upright[-1])
        np.testing.assert_allclose(turned, upright if same_end else upright[::-1], atol=1e-9)
    else:
        assert "sides swapped" in found.skipped[0].reason
