import numpy as np
import torch
from scipy.spatial import cKDTree

from svim3d.mesh.texels import average_down, fill_empty, rasterize_uv, to_image

SQUARE = torch.tensor([[0.25, 0.25], [0.75, 0.25], [0.75, 0.75], [0.25, 0.75]])
TWO = torch.tensor([[0, 1, 2], [0, 2, 3]])


def test_every_centre_inside_is_found_and_its_position_exact():
    texels = rasterize_uv(SQUARE, TWO, 64)
    inside = texels.barycentric.min(1).values > 1e-6
    assert int(inside.sum()) + 32 == 32 * 32  # but those on the diagonal, which lie on an edge
    centre = torch.stack([texels.pixel % 64, texels.pixel // 64], 1).add(0.5) / 64
    found = texels.interpolate(TWO, SQUARE)
    covered = ((centre > 0.25) & (centre < 0.75)).all(1)
    assert int(covered.sum()) == 32 * 32
    assert torch.allclose(found[covered], centre[covered], atol=1e-6)
    # Beyond the border the surface's nearest point is shown, one texel far and no farther.
    assert torch.allclose(found, centre.clamp(0.25, 0.75), atol=1e-6)
    assert len(texels.pixel) == 34 * 34
    assert texels.overlaps == 0


def test_orientation_does_not_matter():
    a, b = rasterize_uv(SQUARE, TWO, 32), rasterize_uv(SQUARE, TWO[:, [0, 2, 1]], 32)
    assert torch.equal(a.pixel, b.pixel)
    assert torch.allclose(a.interpolate(TWO, SQUARE), b.interpolate(TWO[:, [0, 2, 1]], SQUARE))


def test_overlaps_are_counted_and_shared_edges_are_none():
    again = torch.cat([TWO, torch.tensor([[0, 1, 2]])])
    texels = rasterize_uv(SQUARE, again, 64)
    assert 32 * 31 / 2 - 64 <= texels.overlaps <= 32 * 32 / 2
    assert set(texels.overlapping.tolist()) == {2}


def test_faces_smaller_than_a_texel_and_lines_still_show():
    tiny = torch.tensor([[0.501, 0.501], [0.502, 0.501], [0.501, 0.502]])
    for points in (tiny, tiny[[0, 1, 1]]):
        texels = rasterize_uv(points, torch.tensor([[0, 1, 2]]), 16)
        assert len(texels.pixel) >= 1
        assert torch.isfinite(texels.barycentric).all()
        assert torch.allclose(texels.barycentric.sum(1), torch.ones(len(texels.pixel)))


def test_result_does_not_depend_on_the_number_of_threads():
    import numba

    generator = torch.Generator().manual_seed(0)
    uv = torch.rand(90, 2, generator=generator)
    faces = torch.arange(90).view(-1, 3)
    before, threads = rasterize_uv(uv, faces, 50), numba.get_num_threads()
    numba.set_num_threads(1)
    after = rasterize_uv(uv, faces, 50)
    numba.set_num_threads(threads)
    assert torch.equal(before.face, after.face)
    assert torch.equal(before.barycentric, after.barycentric)


def test_empty_texels_take_the_nearest_value():
    generator = torch.Generator().manual_seed(0)
    filled = torch.rand(40, 30, generator=generator) < 0.05
    image = torch.rand(40, 30, 3, generator=generator)
    result = fill_empty(image, filled)
    assert torch.equal(result[filled], image[filled])
    known = torch.nonzero(filled)
    tree = cKDTree(known.numpy())
    empty = torch.nonzero(~filled)
    distance, _ = tree.query(empty.numpy())
    candidates = torch.cdist(
        empty.float(), known.float(), compute_mode="donot_use_mm_for_euclid_dist"
    )
    for position, reach, row in zip(empty, distance, candidates, strict=True):
        nearest = image[filled][np.flatnonzero(row.numpy() <= reach + 1e-6)]
        assert (nearest == result[position[0], position[1]]).all(1).any()


def test_an_empty_texture_stays():
    image = torch.zeros(4, 4, 3)
    assert fill_empty(image, torch.zeros(4, 4, dtype=torch.bool)) is image


def test_supersampling_averages_what_is_covered():
    texels = rasterize_uv(SQUARE, TWO, 64)
    values = texels.interpolate(TWO, SQUARE)
    mean, coarse = average_down(values, texels, 4)
    assert coarse.size == 16
    centre = torch.stack([coarse.pixel % 16, coarse.pixel // 16], 1).add(0.5) / 16
    inner = ((centre > 0.25) & (centre < 0.75)).all(1)
    assert torch.allclose(mean[inner], centre[inner], atol=1e-6)
    image = to_image(mean, coarse)
    assert image.shape == (16, 16, 2)
    assert torch.allclose(image[0, 0], mean[0])
    assert average_down(values, texels, 1)[0] is values
