"""`svim3d model`: a single file becomes a folder that loads, and faults are told in one line."""

import json
import math
import struct

import pytest
import single_file
import torch
from safetensors.torch import load_file, save_file

from flows import cli
from stages.model_files import license_line
from svim3d.diffusion.model import PAPER, MaterialDiffusion
from svim3d.io.model_folder import read_model, write_description

SMALL = single_file.SMALL
FIRST = f"{single_file.UNET}input_blocks.0.0.weight"
LAST = f"{single_file.UNET}out.2.weight"
SOME_NORM = f"{single_file.UNET}input_blocks.4.1.time_stack.0.norm_in.bias"


@pytest.fixture(scope="module")
def tensors():
    return single_file.filled(single_file.whole(SMALL))


@pytest.fixture(scope="module")
def file(tensors, tmp_path_factory):
    file = tmp_path_factory.mktemp("weights") / "sv3d_p.safetensors"
    save_file(tensors, file)
    return file


@pytest.fixture(autouse=True)
def wide_console(monkeypatch):
    monkeypatch.setenv("COLUMNS", "200")


def model(*arguments):
    return cli.main(["model", *map(str, arguments)])


def parameters(shapes):
    return f"{sum(math.prod(shape) for shape in shapes.values()):,} parameters"


def test_a_converted_file_is_told_of_and_loads(file, tensors, tmp_path, capsys):
    out = tmp_path / "new" / "model"
    assert model("convert", file, out) == cli.DONE
    told = capsys.readouterr().out
    assert "SV3D_p: 4 output channels made 16 by copying (mean)" in told
    assert "is used (it is the same)" in told and "CLIP's text tower" in told
    assert [entry.name for entry in out.parent.iterdir()] == ["model"]

    assert model("info", out) == cli.DONE
    told = capsys.readouterr().out
    ours = single_file.Widths(**{**vars(SMALL), "inputs": 20, "outputs": 16})
    for expected in (
        parameters(single_file.unet(ours)),
        parameters(single_file.autoencoder(SMALL)),
        parameters(single_file.image_tower(SMALL)),
        "20 in, 16 out, 4 per group",
        "rgb, basecolor, orm, normal",
        "21 of 576 x 576 px, latents 72 x 72",
        "50 steps, noise 700 to 0.002 (rho 7), guidance 1 to 2.5",
        "F16",
        "Stability AI Non-Commercial Research Community License",
    ):
        assert expected in told
    assert "fault" not in told

    loaded = read_model(out, torch.device("cpu"), torch.float32)
    first, old = loaded.unet.conv_in.weight, tensors[FIRST]
    for group in first[:, :16].split(4, 1):
        assert torch.equal(group, (old[:, :4] / 4).half().float())
    assert torch.equal(first[:, 16:], old[:, 4:].half().float())
    for name, network in loaded.parts.items():
        assert not any(p.is_meta for p in network.parameters()), name


def test_the_folder_carries_the_licence_s_notice(file, tmp_path):
    assert model("convert", file, tmp_path / "out", "--groups", "1") == cli.DONE
    notice = " ".join((tmp_path / "out" / "NOTICE").read_text().split())
    assert (
        "This Stability AI Model is licensed under the Stability AI Non-Commercial Research "
        "Community License, Copyright (c) Stability AI Ltd. All Rights Reserved." in notice
    )
    assert "all 4 output channels kept" in notice
    assert "every model trained" in (tmp_path / "out" / "README.md").read_text()


def test_copies_types_and_groups_are_as_asked_for(file, tensors, tmp_path):
    out = tmp_path / "out"
    assert model("convert", file, out, "--inflate", "copy", "--dtype", "fp32") == cli.DONE
    unet = load_file(out / "unet.safetensors")
    assert torch.equal(unet["conv_in.weight"][:, 12:], tensors[FIRST])
    assert torch.equal(unet["conv_out.weight"][4:8], tensors[LAST])
    assert json.loads((out / "model.json").read_text())["groups"] == list(PAPER.groups)
    assert model("convert", file, tmp_path / "one", "--groups", 1, "--dtype", "bf16") == cli.DONE
    unet = load_file(tmp_path / "one" / "unet.safetensors")
    assert torch.equal(unet["conv_in.weight"], tensors[FIRST].bfloat16())
    assert json.loads((tmp_path / "one" / "model.json").read_text())["groups"] == ["rgb"]


def test_a_file_is_told_of_by_its_header(tmp_path, capsys):
    file = tmp_path / "sv3d_p.safetensors"
    full = single_file.Widths()
    single_file.write_zeros(file, single_file.whole(full))
    assert model("info", file) == cli.DONE
    told = capsys.readouterr().out
    for expected in (
        "single file, SV3D_p",
        "1,525,278,442 parameters in 1,428 tensors",
        "83,653,863 parameters",
        "632,076,800 parameters",
        "49,490,179 parameters in 138 tensors, left out",
        "51,723,265 parameters in 6 tensors, left out",
        "8 in, 4 out",
    ):
        assert expected in told


def test_a_folder_of_the_paper_s_size_is_told_of(tmp_path, capsys):
    with torch.device("meta"):
        networks = MaterialDiffusion.untrained(PAPER).parts
    for name, network in networks.items():
        shapes = {n: tuple(t.shape) for n, t in network.state_dict().items()}
        single_file.write_zeros(tmp_path / f"{name}.safetensors", shapes)
    write_description(tmp_path, PAPER, "# A card that says nothing of it\n")
    assert model("info", tmp_path) == cli.DONE
    told = capsys.readouterr().out
    assert "1,525,347,574 parameters in 1,428 tensors" in told
    assert "not said: README.md has no line on it" in told


def test_a_folder_that_would_not_load_is_told_of_and_fails(file, tmp_path, capsys):
    out = tmp_path / "out"
    assert model("convert", file, out) == cli.DONE
    unet = load_file(out / "unet.safetensors")
    del unet["conv_out.bias"]
    save_file(unet, out / "unet.safetensors")
    capsys.readouterr()
    assert model("info", out) == cli.FAILED
    assert "unet: the tensors do not fit" in capsys.readouterr().out
    (out / "unet.safetensors").unlink()
    assert model("info", out) == cli.BAD_INPUT
    assert "there is no file" in capsys.readouterr().err


def test_other_kinds_are_told_of_and_said_to_be_unusable(tmp_path, capsys):
    file = tmp_path / "a.safetensors"
    single_file.write_zeros(file, single_file.whole(single_file.Widths(told=256)))
    assert model("info", file) == cli.FAILED
    told = capsys.readouterr().out
    assert "1,523,967,722 parameters" in told and "told no elevation" in told


def with_shapes(**changes):
    """Shapes of the small file with some changed; None takes a tensor out."""
    shapes = single_file.whole(SMALL) | changes
    return {name: shape for name, shape in shapes.items() if shape is not None}


@pytest.mark.parametrize(
    ("shapes", "complaint"),
    [
        (single_file.whole(single_file.Widths(told=256)), "this is SV3D_u"),
        (single_file.whole(single_file.Widths(told=768)), "this is Stable Video Diffusion"),
        ({"conv_in.weight": (320, 20, 3, 3)}, "one network of a model folder: name the folder"),
        (
            with_shapes(**{"model_ema.decay": (1,)}),
            "1 tensors that SV3D_p does not have: model_ema",
        ),
        (with_shapes(**{SOME_NORM: None}), "1 missing (down_blocks.1.attentions.0.temporal_"),
        (with_shapes(**{SOME_NORM: (7,)}), "norm_in.bias (7,) for (64,)"),
        (with_shapes(**{FIRST: (64, 20, 3, 3), LAST: (16, 64, 3, 3)}), "conv_out.bias (4,) for"),
        (with_shapes(**{f"{single_file.CLIP}visual.class_embedding": None}), "it is missing"),
    ],
    ids=["u", "svd", "folder", "unknown", "missing", "shape", "mixed", "size"],
)
def test_files_that_do_not_fit_are_refused_in_one_line(shapes, complaint, tmp_path, capsys):
    file = tmp_path / "a.safetensors"
    single_file.write_zeros(file, shapes)
    assert model("convert", file, tmp_path / "out") == cli.BAD_INPUT
    lines = capsys.readouterr().err.strip().splitlines()
    assert len(lines) == 1 and str(file) in lines[0] and complaint in lines[0]
    assert list(tmp_path.iterdir()) == [file]


def test_a_model_of_four_groups_keeps_them(tmp_path, capsys):
    file = tmp_path / "ours.safetensors"
    ours = single_file.Widths(**{**vars(SMALL), "inputs": 20, "outputs": 16})
    single_file.write_zeros(file, single_file.whole(ours))
    assert model("convert", file, tmp_path / "out", "--groups", 1) == cli.BAD_INPUT
    assert "has 4 groups already" in capsys.readouterr().err
    assert model("convert", file, tmp_path / "out") == cli.DONE
    assert "SViM3D: all 16 output channels kept" in capsys.readouterr().out


def test_a_number_that_the_type_cannot_hold_leaves_nothing_behind(tmp_path, capsys):
    file = tmp_path / "a.safetensors"
    starts = single_file.write_zeros(file, single_file.whole(SMALL), "F32")
    with file.open("r+b") as stream:
        stream.seek(starts[SOME_NORM])
        stream.write(struct.pack("<f", 1e6))
    assert model("convert", file, tmp_path / "out") == cli.BAD_INPUT
    assert "norm_in.bias is not finite in F16" in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == [file]
    assert model("convert", file, tmp_path / "out", "--dtype", "bf16") == cli.DONE


@pytest.mark.parametrize("action", ["convert", "info"])
def test_unreadable_files_are_refused_in_one_line(action, file, tmp_path, capsys):
    short, pickled = tmp_path / "short.safetensors", tmp_path / "a.ckpt"
    with file.open("rb") as stream:
        short.write_bytes(stream.read(1000))
    torch.save({"state_dict": {}}, pickled)
    rest = [tmp_path / "out"] if action == "convert" else []
    for given, complaint in (
        (tmp_path / "none.safetensors", "there is no file"),
        (short, "is no complete safetensors file"),
        (pickled, "is pickled"),
        (tmp_path, "there is no file" if action == "convert" else "wanted a model folder"),
    ):
        assert model(action, given, *rest) == cli.BAD_INPUT
        lines = capsys.readouterr().err.strip().splitlines()
        assert len(lines) == 1 and complaint in lines[0]


def test_folders_that_are_taken_stay_as_they_are(file, tmp_path, capsys):
    taken = tmp_path / "taken"
    taken.mkdir()
    (taken / "thesis.txt").write_text("years of work")
    assert model("convert", file, taken) == cli.BAD_INPUT
    assert "is there already; choose another folder" in capsys.readouterr().err
    assert model("convert", file, taken / "thesis.txt" / "model") == cli.BAD_INPUT
    assert "cannot be written" in capsys.readouterr().err
    assert (taken / "thesis.txt").read_text() == "years of work"


def test_a_damaged_description_is_refused(tmp_path, capsys):
    write_description(tmp_path, PAPER, "")
    description = json.loads((tmp_path / "model.json").read_text())
    (tmp_path / "model.json").write_text(json.dumps({**description, "unet": {}}))
    for name in ("unet", "autoencoder", "image_encoder"):
        save_file({"a": torch.zeros(1)}, tmp_path / f"{name}.safetensors")
    assert model("info", tmp_path) == cli.BAD_INPUT
    assert "model.json is damaged: KeyError('in_channels')" in capsys.readouterr().err


@pytest.mark.parametrize("action", ["convert", "info"])
def test_actions_explain_themselves(action, capsys):
    with pytest.raises(SystemExit) as stopped:
        cli.main(["model", action, "--help"])
    assert stopped.value.code == 0
    assert f"svim3d model {action}" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("card", "line"),
    [
        ("# Model\n\nLicence: MIT, of the code\n", "MIT, of the code"),
        ("---\nlicense: apache-2.0\n---\n", "apache-2.0"),
        ("# Model\n\n## License\n\nCC0, take it.\nMore.\n", "CC0, take it."),
        ("**License**: MIT", "MIT"),
        ("The licences of others do not matter.", None),
        ("## Licence", None),
    ],
)
def test_a_card_s_licence_is_found(card, line):
    assert license_line(card) == line
