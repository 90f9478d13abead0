"""The sheet of an orbit: views in order of azimuth, every kind of image in its row."""

import torch
from sphere_orbit import sphere_cameras, sphere_images

from svim3d.io import orbit_sheet as module
from svim3d.io.image import SHEET_MARGIN_PX, SHEET_TEXT_PX
from svim3d.io.orbit_sheet import orbit_sheet

STEP_X = module.CELL_PX + SHEET_MARGIN_PX
STEP_Y = module.CELL_PX + SHEET_TEXT_PX + 3 * SHEET_MARGIN_PX


def cell(sheet: torch.Tensor, row: int, column: int) -> torch.Tensor:
    y = row * STEP_Y + SHEET_TEXT_PX + 2 * SHEET_MARGIN_PX
    x = column * STEP_X + SHEET_MARGIN_PX
    return sheet[y : y + module.CELL_PX, x : x + module.CELL_PX]


def test_views_stand_in_order_of_azimuth_beginning_at_the_reference():
    cameras = sphere_cameras(views=5, size=32)
    images = sphere_images(cameras)
    # Reflectances that tell the views apart: the reference, which is the last, is brightest.
    grey = torch.tensor([0.3, 0.5, 0.7, 0.9, 1.0])[:, None, None, None]
    sheet = orbit_sheet(cameras, images | {"roughness": grey * images["mask"]})
    assert sheet.shape[:2] == (5 * STEP_Y, 5 * STEP_X + SHEET_MARGIN_PX)
    middle = [float(cell(sheet, 2, column)[64, 64, 0]) for column in range(5)]
    torch.testing.assert_close(
        torch.tensor(middle), torch.tensor([1.0, 0.3, 0.5, 0.7, 0.9]), rtol=0, atol=1 / 255
    )


def test_normals_face_the_camera_and_confidence_has_a_row():
    cameras = sphere_cameras(views=4, size=32)
    images = sphere_images(cameras)
    confidence = torch.full_like(images["mask"], 0.25)
    sheet = orbit_sheet(cameras, images | {"confidence": confidence})
    assert sheet.shape[0] == 6 * STEP_Y
    for column in range(4):
        # The sphere's middle looks at the camera: (0.5, 0.5, 1).
        colour = cell(sheet, 4, column)[64, 64]
        torch.testing.assert_close(colour, torch.tensor([0.5, 0.5, 1.0]), rtol=0, atol=0.05)
        torch.testing.assert_close(
            cell(sheet, 5, column)[64, 64], torch.full((3,), 0.25), rtol=0, atol=1 / 255
        )


def test_long_orbits_are_thinned():
    cameras = sphere_cameras(views=21, size=16)
    sheet = orbit_sheet(cameras, sphere_images(cameras))
    assert sheet.shape[1] == module.COLUMNS * STEP_X + SHEET_MARGIN_PX
