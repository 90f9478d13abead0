import json

import pytest
import torch

from svim3d.cameras import orbit_cameras
from svim3d.io.edit_record import EditRecord, read_record, read_region
from svim3d.io.image import write_png
from svim3d.shading.material_edits import Edit

EDITS = (Edit.parse("roughness*0.5"), Edit.parse("basecolor=#aa3311"))


def write(files, folder):
    for name, content in files.items():
        (folder / name).write_bytes(content)


def test_records_come_back(tmp_path):
    camera = orbit_cameras([(10.0, 30.0)], radius=2.0, fov_y_deg=30.0, size=16)
    region = torch.zeros(16, 16, 1)
    region[4:8, 4:8] = 1.0
    write(EditRecord(EDITS, region, camera).files(), tmp_path)
    again = read_record(tmp_path / "edits.json")
    assert again.edits == EDITS
    assert torch.equal(again.region, region)
    assert torch.equal(again.camera.c2w, camera.c2w)
    assert (again.camera.fov_y_deg, again.camera.height, again.camera.width) == (30.0, 16, 16)


def test_records_without_a_region(tmp_path):
    write(EditRecord(EDITS).files(), tmp_path)
    again = read_record(tmp_path / "edits.json")
    assert again == EditRecord(EDITS)
    assert not (tmp_path / "mask.png").exists()


@pytest.mark.parametrize(
    "page",
    ["", "[]", "{}", '{"format": 1}', '{"format": 2, "edits": []}', '{"format": 1, "edits": ["x"]}',
     '{"format": 1, "edits": [], "mask": "mask.png", "camera": {"c2w": [1, 2]}}'],
)  # fmt: skip
def test_damaged_records_are_refused(tmp_path, page):
    (tmp_path / "edits.json").write_text(page)
    with pytest.raises(ValueError, match=r"record of edits|wanted"):
        read_record(tmp_path / "edits.json")


def test_a_mask_is_looked_for_beside_the_record_only(tmp_path):
    (tmp_path / "inner").mkdir()
    write_png(tmp_path / "mask.png", torch.ones(4, 4, 1))
    page = {"format": 1, "edits": [], "mask": "../mask.png", "camera": {
        "c2w": torch.eye(4).tolist(), "fov_y_deg": 30.0, "height": 4, "width": 4}}  # fmt: skip
    (tmp_path / "inner" / "edits.json").write_text(json.dumps(page))
    with pytest.raises(ValueError, match="does not exist"):
        read_record(tmp_path / "inner" / "edits.json")


def test_transparent_is_outside_a_region(tmp_path):
    picture = torch.ones(4, 4, 4)
    picture[:2, :, 3] = 0.0
    write_png(tmp_path / "region.png", picture)
    assert float(read_region(tmp_path / "region.png").mean()) == 0.5
