"""The guides' commands are carried out as they stand, with tiny settings added.

Each `sh` block runs line by line in its guide's own folder, where the inputs lie that guides speak
of; files of `python` blocks are written and `diff` blocks applied to a copy of the project before.
`console` blocks are for what needs a server, a network or a GPU.
"""

import contextlib
import io
import json
import os
import re
import shlex
import shutil
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import asdict, replace
from pathlib import Path

import pytest
import single_file
import torch
from drawn_sphere import drawn_sphere
from safetensors.torch import save_file
from scored_sphere import write_truth
from sphere_orbit import sphere_cameras, sphere_images
from tiny_asset import TINY_ASSET
from tiny_model import TINY

from flows import cli
from svim3d.diffusion.model import MaterialDiffusion
from svim3d.io.exr import write_rgb
from svim3d.io.glb import glb_bytes
from svim3d.io.image import read_png, write_png
from svim3d.io.model_folder import FORMAT
from svim3d.io.orbit import write_orbit

PROJECT = Path(__file__).resolve().parents[2]
DOCS = PROJECT / "docs"
BLOCK = re.compile(r"^```(\w+)\n(.*?)^```$", re.M | re.S)
FILE = re.compile(r"# file: (\S+)\n")
PATCHED = "+++ b/"
PACKAGES = ("flows", "stages")  # copied where a guide changes them
INSTALL = ("pip", "pytest")  # what .ci/run does itself

SMALL_ASSET = [part for setting in TINY_ASSET for part in ("--set", setting)]
SMALL_PHOTO = ["--set", "generation.photo_view_size=64", "--set", "prepare.size=64", *SMALL_ASSET]
SMALL_VIEWS = ["--set", "generation.views=4", "--set", "generation.size=24"]
SMALL_TRAINING = [
    part
    for setting in (
        "autoencoder.steps=2",
        "autoencoder.batch=4",
        "autoencoder.objects=2",
        "expectation.steps=2",
        "expectation.batch=2",
        "generator.phase_1_steps=1",
        "generator.phase_2_steps=1",
        "generator.batch=1",
        "generator.warm_up=1",
        "generator.precision=float32",
    )
    for part in ("--set", setting)
]
# What is added to a command, after its own options: the last of two is taken.
ADDED = {
    "run": [*SMALL_PHOTO, *SMALL_VIEWS, "--device", "cpu"],
    "plan": [*SMALL_PHOTO, *SMALL_VIEWS],
    "batch": [*SMALL_PHOTO, *SMALL_VIEWS, "--device", "cpu"],
    "relight": ["--size", "48", "--orbit-views", "6", "--device", "cpu"],
    "data": ["--objects", "2", "--size", "16", "--views", "5", "--lights", "2", "--workers", "1"],
    "train": [*SMALL_TRAINING, "--device", "cpu"],
    "evaluate": SMALL_ASSET,
    "stability": ["--size", "32", "--views", "4", *SMALL_ASSET],
}
STORELESS = ("presets", "model")
SHELL_S = 30.0  # of what is no command of ours: what runs on is a server, and no guide's to start

pytestmark = [pytest.mark.flow, pytest.mark.slow]


def blocks(guide: Path, language: str) -> list[str]:
    return [text for name, text in BLOCK.findall(guide.read_text()) if name == language]


def lines(guide: Path) -> Iterator[str]:
    """Commands, without comments and without what installs things."""
    for block in blocks(guide, "sh"):
        for line in block.replace("\\\n", " ").splitlines():
            for command in line.split("&&"):
                words = shlex.split(command, comments=True)
                if words and words[0] not in INSTALL:
                    yield command.strip()


GUIDES = [
    guide for guide in (PROJECT / "README.md", *sorted(DOCS.glob("*.md"))) if any(lines(guide))
]


@pytest.fixture(scope="module")
def store(tmp_path_factory) -> Path:
    """One for all guides: what one has made another finds."""
    return tmp_path_factory.mktemp("guides") / "store"


@pytest.fixture
def desk(tmp_path: Path, monkeypatch) -> Path:
    """The folder that commands run in, with all that guides speak of."""
    desk = tmp_path / "desk"
    desk.mkdir()
    monkeypatch.chdir(desk)
    monkeypatch.setenv("COLUMNS", "200")
    (desk / "configs").symlink_to(PROJECT / "configs")
    photo = read_png(PROJECT / "configs" / "example_photo.png")
    write_png(desk / "photo.png", photo)
    (desk / "photos").mkdir()
    # Of their own, so that other guides' runs do not answer for them.
    write_png(desk / "photos" / "chair.png", 0.9 * photo)
    write_png(desk / "photos" / "lamp.png", photo.flip(1))
    cameras = sphere_cameras()
    write_orbit(desk / "views", cameras, sphere_images(cameras), reference=len(cameras) - 1)
    write_truth(desk / "data" / "orbits" / "ball", size=16)
    for folder in ("glbs", "hdris"):
        (desk / folder).mkdir()
    for file in ("chair.glb", "glbs/chair.glb"):
        (desk / file).write_bytes(tetrahedron())
    sky = torch.rand(16, 32, 3, generator=torch.Generator().manual_seed(0)).numpy()
    for file in ("sunset.exr", "hdris/sunset.exr"):
        write_rgb(desk / file, sky)
    weights = single_file.filled(single_file.whole(single_file.SMALL))
    save_file(weights, desk / "sv3d_p.safetensors")
    autoencoder = {"patch": 4, "latent_channels": 2, "hidden": 8, "layers": 1}
    spec = {"format": FORMAT, **asdict(replace(TINY, autoencoder=autoencoder))}
    (desk / "tiny.json").write_text(json.dumps(spec))
    return desk


def tetrahedron() -> bytes:
    corners = torch.tensor([[1.0, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]])
    return glb_bytes(
        vertices=corners,
        faces=torch.tensor([[0, 1, 2], [0, 3, 1], [0, 2, 3], [1, 3, 2]]),
        normals=torch.nn.functional.normalize(corners, dim=-1),
        basecolor=torch.full((4, 3), 0.5),
        orm=torch.tensor([[1.0, 0.5, 0.0]]).expand(4, 3),
    )


def svim3d_arguments(words: list[str], store: Path) -> list[str]:
    """The command's words with tiny settings, and the store that the guides share."""
    name, *given = words
    added = list(ADDED.get(name, ()))
    if name == "train" and "--model" not in given:
        added += ["--model", "tiny.json"]
    if "--store" not in given and name not in STORELESS:
        added += ["--store", str(store)]
    return [name, *given, *added]


def change_a_copy(guide: Path, desk: Path) -> dict[str, str]:
    """Put a guide's files and changes into a copy of the project; the environment that runs it."""
    for package in PACKAGES:
        shutil.copytree(PROJECT / package, desk / package)
    for text in blocks(guide, "python"):
        name = FILE.match(text)
        assert name, f"{guide.name}: a block of Python without its file"
        (desk / name[1]).write_text(text[name.end() :])
    for text in blocks(guide, "diff"):
        apply(text, desk)
    path = os.pathsep.join([str(desk), str(PROJECT)])
    return dict(os.environ) | {"PYTHONPATH": path}


def apply(text: str, folder: Path) -> None:
    """Apply a diff without line numbers: each hunk's old lines stand in the file just once."""
    head, *hunks = text.split("@@\n")
    (name,) = [line for line in head.splitlines() if line.startswith(PATCHED)]
    file = folder / name.removeprefix(PATCHED)
    content = file.read_text()
    for hunk in hunks:
        rows = hunk.splitlines(keepends=True)
        old = "".join(row[1:] for row in rows if row[0] in " -")
        new = "".join(row[1:] for row in rows if row[0] in " +")
        assert content.count(old) == 1, f"{file.name} does not hold once: {old}"
        content = content.replace(old, new)
    file.write_text(content)


def carry_out(command: str, store: Path, environment: dict[str, str] | None) -> tuple[int, str]:
    """Exit code and what was said."""
    words = shlex.split(command, comments=True)
    if words[0] != "svim3d":
        done = subprocess.run(
            ["sh", "-ec", command], capture_output=True, text=True, check=False, timeout=SHELL_S
        )
        return done.returncode, done.stdout + done.stderr
    arguments = svim3d_arguments(words[1:], store)
    if environment is not None:
        line = [sys.executable, "-m", "flows.cli", *arguments]
        done = subprocess.run(line, env=environment, capture_output=True, text=True, check=False)
        return done.returncode, done.stdout + done.stderr
    said = io.StringIO()
    with contextlib.redirect_stdout(said), contextlib.redirect_stderr(said):
        code = cli.main(arguments)
    return code, said.getvalue()


@pytest.mark.parametrize("guide", GUIDES, ids=lambda guide: guide.stem)
def test_the_commands_of_a_guide_work(guide, desk, store, engine, monkeypatch):
    environment = change_a_copy(guide, desk) if blocks(guide, "diff") else None
    decode = MaterialDiffusion.decode

    def draw(model, *rest):
        """What a tiny model of a guide would draw if it had been trained."""
        small = model.spec.image_size == TINY.image_size
        return drawn_sphere(TINY.views, TINY.image_size) if small else decode(model, *rest)

    monkeypatch.setattr(MaterialDiffusion, "decode", draw)
    for command in lines(guide):
        code, said = carry_out(command, store, environment)
        assert code == cli.DONE, f"{command}\n{said[-3000:]}"


def anchors(guide: Path) -> set[str]:
    """What headings are linked by."""
    headings = re.findall(r"^#+ (.+)$", guide.read_text(), re.M)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}


def test_links_of_guides_lead_somewhere():
    for guide in (PROJECT / "README.md", *DOCS.glob("*.md")):
        for link, _, anchor in re.findall(r"\]\(([^)#:\s]*)(#([^)\s]*))?\)", guide.read_text()):
            target = guide.parent / link if link else guide
            assert target.exists(), f"{guide.name}: {link}"
            assert not anchor or anchor in anchors(target), f"{guide.name}: {link}#{anchor}"


def test_scripts_that_pages_name_exist():
    for page in (PROJECT / "README.md", *DOCS.glob("*.md")):
        for script in re.findall(r"\bbenchmarks/\w+\.py\b", page.read_text()):
            assert (PROJECT / script).exists(), f"{page.name}: {script}"


def test_events_of_the_troubleshooting_page_exist():
    code = "".join(
        file.read_text()
        for package in ("stages", "svim3d")
        for file in (PROJECT / package).rglob("*.py")
    )
    rows = [row.split("|") for row in (DOCS / "troubleshooting.md").read_text().splitlines()]
    kinds = [kind for row in rows if len(row) == 5 for kind in re.findall(r"`(\w+)`", row[2])]
    assert len(kinds) > 20
    for kind in kinds:
        assert f'"{kind}"' in code, kind
