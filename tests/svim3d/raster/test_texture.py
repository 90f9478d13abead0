import torch

from svim3d.raster.texture import sample_texture


def checker(height: int = 4, width: int = 6) -> torch.Tensor:
    return torch.rand(
        height, width, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0)
    )


def centres(height: int, width: int) -> torch.Tensor:
    y, x = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
    return torch.stack([(x + 0.5) / width, (y + 0.5) / height], -1).double().view(-1, 2)


def test_texel_centres_are_exact_and_row_0_is_at_v_0():
    texture = checker()
    assert torch.allclose(sample_texture(texture, centres(4, 6)), texture.view(-1, 3), atol=1e-14)


def test_between_texels_the_value_is_bilinear_and_edges_repeat():
    texture = checker()
    uv = torch.tensor([[2 / 6, 2 / 4], [0.0, 0.5 / 4], [1.0, 0.5 / 4], [-5 / 6, 2.5]]).double()
    expected = torch.stack(
        [
            texture[1:3, 1:3].mean((0, 1)),
            0.5 * (texture[0, 0] + texture[0, 5]),
            0.5 * (texture[0, 0] + texture[0, 5]),
            texture[1:3, 0:2].mean((0, 1)),
        ]
    )
    assert torch.allclose(sample_texture(texture, uv), expected, atol=1e-14)


def test_gradients_match_finite_differences():
    uv = torch.tensor([[0.31, 0.42], [0.97, 0.05], [-0.3, 1.7]]).double().requires_grad_()
    assert torch.autograd.gradcheck(sample_texture, (checker().requires_grad_(), uv))
