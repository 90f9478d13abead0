import json

import pytest
import torch

from svim3d.io.scene import read_scene

PLAIN = {"basecolor": [[0.5, 0.25, 0.125]], "roughness": [0.75], "metallic": 0, "pattern": "plain"}
METAL = {"basecolor": [[0.9, 0.8, 0.7]], "roughness": [0.25], "metallic": 1, "pattern": "plain"}
PROFILE = [[0, 0], [1, 0], [1, 1], [1, 2], [0, 2]]


def scene(tmp_path, material=PLAIN, bands=((2, "a"), (4, "b"))):
    file = tmp_path / "scene.json"
    part = {"lathe": PROFILE, "bands": bands}
    file.write_text(json.dumps({"materials": {"a": material, "b": METAL}, "parts": [part]}))
    return file


def test_bands_change_material_at_their_control_points(tmp_path):
    (material,) = read_scene(scene(tmp_path)).materials
    rows = len(material.basecolor)
    low, high = material.basecolor[: rows // 2], material.basecolor[rows // 2 :]
    torch.testing.assert_close(low, torch.tensor([0.5, 0.25, 0.125]).expand_as(low))
    torch.testing.assert_close(high, torch.tensor([0.9, 0.8, 0.7]).expand_as(high))
    expected = torch.tensor([0.75, 0.0]), torch.tensor([0.25, 1.0])
    for half, value in zip(material.roughness_metallic.split(rows // 2), expected, strict=True):
        torch.testing.assert_close(half, value.expand_as(half))


@pytest.mark.parametrize(
    "pattern",
    [
        {"pattern": "noise", "cells": [6, 9]},
        {"pattern": "speckle", "cells": [6, 9]},
        {"pattern": "rings", "cells": 40},
        {"pattern": "stripes", "count": 5, "twist": 0.5},
    ],
)
def test_patterns_stay_between_their_ends_and_close_around(tmp_path, pattern):
    ends = {"basecolor": [[0.0] * 3, [1.0] * 3], "roughness": [0.2, 0.6], "metallic": 0}
    (material,) = read_scene(scene(tmp_path, ends | pattern, [(4, "a")])).materials
    weight = material.basecolor[..., 0]
    assert 0.0 <= float(weight.min()) < 0.35 and 0.65 < float(weight.max()) <= 1.0
    torch.testing.assert_close(material.roughness_metallic[..., 0], 0.2 + 0.4 * weight)
    step_across_seam = (weight[:, 0] - weight[:, -1]).abs().max()
    assert float(step_across_seam) <= 2.0 * float(weight.diff(dim=1).abs().max()) + 1e-6


def test_equal_scenes_are_equal(tmp_path):
    noisy = {"basecolor": [[0.0] * 3, [1.0] * 3], "roughness": [0, 1], "metallic": 0}
    file = scene(tmp_path, noisy | {"pattern": "noise", "cells": [4, 4]})
    first, second = read_scene(file), read_scene(file)
    assert torch.equal(first.vertices, second.vertices)
    assert torch.equal(first.materials[0].basecolor, second.materials[0].basecolor)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"bands": [[4, "c"]]}, "'c' is missing"),
        ({"lathe": [[0, 0], [1, 1]]}, "on the axis"),
        ({"bands": None}, "wrong kind"),
    ],
)
def test_broken_scene_is_refused(tmp_path, change, said):
    file = scene(tmp_path)
    content = json.loads(file.read_text())
    content["parts"][0] |= change
    file.write_text(json.dumps(content))
    with pytest.raises(ValueError, match=said):
        read_scene(file)


def test_unknown_pattern_is_refused(tmp_path):
    with pytest.raises(ValueError, match="got 'dots'"):
        read_scene(scene(tmp_path, PLAIN | {"pattern": "dots", "cells": [1, 1]}))
