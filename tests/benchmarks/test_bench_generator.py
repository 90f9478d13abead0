"""The judge as a whole: cases from files, every row of an untrained model, tables and sheets."""

import torch
from generator_objects import SIZE, ball, body_case, one_sided

from benchmarks.bench_generator import BASELINES, OURS, judge, report, rows_of
from benchmarks.bench_generator_settings import Setting, compare_seeds, seeds_table, table
from benchmarks.bench_generator_settings import try_settings as try_all
from benchmarks.generator_baselines import learn
from benchmarks.generator_draws import generate
from benchmarks.generator_scores import angle_deg
from benchmarks.generator_sheets import case_sheet
from benchmarks.generator_views import COVERED, read_case, read_examples, read_orbit_case
from svim3d.diffusion.model import MaterialDiffusion, ModelSpec, Sampling
from svim3d.io.training_data import example_file, write_example
from svim3d.synthesis.example import TrainingExample

TINY = ModelSpec(
    name="tiny",
    image_size=SIZE,
    views=21,
    fov_deg=33.8,
    latent_scale=0.5,
    sigma_max=10.0,
    steps=1,
    guidance_max=1.5,
    unet={
        "in_channels": 20,
        "out_channels": 16,
        "block_out_channels": [32, 32],
        "num_attention_heads": [1, 1],
        "layers_per_block": 1,
        "cross_attention_dim": 8,
        "addition_time_embed_dim": 8,
        "attention": [False, False],
    },
    autoencoder={
        "block_out_channels": [8, 8, 8],
        "norm_num_groups": 8,
        "down_block_types": ["DownEncoderBlock2D"] * 3,
        "up_block_types": ["UpDecoderBlock2D"] * 3,
        "latent_channels": 4,
        "layers_per_block": 1,
        "sample_size": SIZE,
    },
    image_encoder={
        "hidden_size": 8,
        "intermediate_size": 8,
        "num_hidden_layers": 1,
        "num_attention_heads": 1,
        "projection_dim": 8,
        "image_size": 16,
        "patch_size": 16,
    },
)


def untrained():
    with torch.random.fork_rng():
        torch.manual_seed(0)
        model = MaterialDiffusion.untrained(TINY)
    for network in model.parts.values():
        network.eval().requires_grad_(False)
    return model


def write_body(folder, case, index=0, quality="good"):
    """Two lights: as it is, and half as bright."""

    def stored(plane):
        return (plane * 255.0).round().to(torch.uint8)

    pictures = case.truth.pictures()
    example = TrainingExample(
        rgb=torch.stack([stored(pictures["rgb"]), stored(0.5 * pictures["rgb"])]),
        basecolor=stored(pictures["basecolor"]),
        orm=stored(pictures["orm"]),
        normal=stored(pictures["normal"]),
        mask=stored(case.truth.mask),
        elevation_deg=case.elevation_deg,
        azimuth_deg=case.azimuth_deg,
        metadata={"fov_deg": "33.8", "quality": quality, "name": "body", "seed": "0"},
    )
    write_example(example_file(folder, index), example)


def test_an_example_comes_back_as_the_case_it_was_made_of(tmp_path):
    case = body_case(ball(), one_sided)
    write_body(tmp_path, case)
    found = read_case(example_file(tmp_path, 0), SIZE, light=0)
    step = 0.5 / 255.0 + 1e-6
    torch.testing.assert_close(found.picture, case.picture, atol=step, rtol=0.0)
    torch.testing.assert_close(found.truth.mask, case.truth.mask, atol=step, rtol=0.0)
    inside = case.truth.mask[..., 0] > COVERED
    # Half an 8-bit step of a value that the mask of at least one half divides.
    rough = (found.truth.roughness - case.truth.roughness)[inside]
    assert float(rough.abs().max()) <= 4.0 * step
    assert float(angle_deg(found.truth.normal, case.truth.normal)[inside].max()) < 2.0
    dark = read_case(example_file(tmp_path, 0), SIZE, light=3)
    torch.testing.assert_close(dark.picture, 0.5 * case.picture, atol=step, rtol=0.0)


def test_smaller_cases_are_means_and_lights_take_turns(tmp_path):
    case = body_case(ball(), one_sided)
    for index in range(4):
        write_body(tmp_path, case, index, quality="low" if index == 3 else "good")
    first, second = read_examples(tmp_path, SIZE // 2, limit=2)
    blocks = case.picture.view(SIZE // 2, 2, SIZE // 2, 2, 3).mean((1, 3))
    torch.testing.assert_close(first.picture, blocks, atol=3e-3, rtol=0.0)
    torch.testing.assert_close(second.picture, 0.5 * blocks, atol=3e-3, rtol=0.0)
    assert [case.has_materials for case in read_examples(tmp_path, SIZE)] == [True] * 3 + [False]
    assert (first.name, second.name) == ("000000 body", "000002 body")  # spread over the folder


def test_every_row_is_judged_and_shown():
    model, case = untrained(), body_case(ball(), one_sided)
    training = learn([case], SIZE)
    sampling = Sampling(steps=1)
    scores, kept = judge(
        [case], lambda c, i: rows_of(model, c, training, sampling, [i, i + 1]), training
    )
    assert set(scores) > {OURS, "ours, mean of 2", *BASELINES}
    text, results = report("ball", scores)
    assert "mean rank" in text
    turned = results["rows"]["oracle: true reference repeated"]["turning"]["all"]
    assert turned["mean_rank"] == 10.5
    again = generate(model, case, 0, sampling)
    assert torch.equal(again.rgb, kept[0][1].rgb)
    sheet = case_sheet(case, again)
    assert sheet.shape[1] > 8 * 2 * SIZE
    assert bool(sheet.isfinite().all())


def test_settings_are_compared_with_the_models_own():
    model, case = untrained(), body_case(ball(), one_sided)
    own = Setting(1, 1.5)
    rows = try_all(model, [case], [own, Setting(2, 1.0)], seed=0)
    text = table(rows, own)
    assert text.count("\n") == 3
    told = compare_seeds(model, [case], own, seed=0, count=2)
    assert told["spread"]["rgb"] > 0.0
    assert "mean of 2" in seeds_table(told)


def test_path_traced_orbits_agree_with_their_reference_picture(data):
    case = read_orbit_case(data / "orbits" / "barrel", 64)
    there = case.truth.mask[-1] > COVERED
    assert case.azimuth_deg[-1] == 0.0
    assert abs(float(case.elevation_deg[-1]) - 10.0) < 1e-3
    # The picture was rendered by itself, with other noise.
    difference = (case.picture - case.truth.rgb[-1]).square().mean()
    assert float(difference) < 1e-3
    assert float((case.mask - case.truth.mask[-1]).abs().mean()) < 0.01
    # Shading normals may lean away from the camera by a little, most face it.
    facing = case.truth.normal[-1][..., 2:][there]
    assert float((facing > 0.0).float().mean()) > 0.98
    columns = torch.nonzero(there[..., 0].any(0))
    rows = torch.nonzero(there[..., 0].any(1))
    longest = max(float(columns.max() - columns.min()), float(rows.max() - rows.min())) + 1
    assert longest / 64 <= 0.92
