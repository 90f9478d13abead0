"""Keys change with whatever can change a result, and with nothing else."""

import dataclasses
import sys
from pathlib import Path

import pytest

from stages.errors import InputError
from stages.keys import Recipe, code_digests, digest_input, library_versions

RECIPE = Recipe("blur", {"radius": 2}, 0, {"source": "abc"}, {"m": "d"}, {"torch": "2"})


@pytest.fixture
def package(tmp_path, monkeypatch):
    """A package of three modules: `blur` imports `kernel`, which imports `constants`."""
    folder = tmp_path / "inked"
    folder.mkdir()
    (folder / "__init__.py").write_text("")
    (folder / "blur.py").write_text(
        "from inked import kernel\n\ndef run(x):\n    return kernel.k(x)\n"
    )
    (folder / "kernel.py").write_text(
        '"""Kernel."""\nfrom .constants import W\n\ndef k(x):\n    return W * x\n'
    )
    (folder / "constants.py").write_text("W = 3\n")
    (folder / "unrelated.py").write_text("V = 1\n")
    monkeypatch.syspath_prepend(tmp_path)
    return folder


def edit(file: Path, old: str, new: str) -> None:
    assert old in file.read_text()
    file.write_text(file.read_text().replace(old, new))


def test_code_covers_what_is_reached_by_imports_and_imports_nothing(package):
    assert set(code_digests("inked.blur")) == {
        "inked",
        "inked.blur",
        "inked.kernel",
        "inked.constants",
    }
    assert "inked" not in sys.modules


@pytest.mark.parametrize(
    ("file", "old", "new", "changed"),
    [
        ("kernel.py", "Kernel.", "Another sentence.", set()),
        ("kernel.py", "return W", "# twice\n    return W", set()),
        ("unrelated.py", "1", "2", set()),
        ("constants.py", "3", "4", {"inked.constants"}),
        ("kernel.py", "W * x", "x * W", {"inked.kernel"}),
        ("blur.py", "def run(x)", "def run(x, y=0)", {"inked.blur"}),
    ],
)
def test_code_digest_sees_meaning_and_not_words(package, file, old, new, changed):
    before = code_digests("inked.blur")
    edit(package / file, old, new)
    after = code_digests("inked.blur")
    assert {name for name in after if after[name] != before[name]} == changed


def test_import_inside_a_function_counts(package):
    edit(package / "blur.py", "    return", "    import inked.unrelated\n    return")
    assert "inked.unrelated" in code_digests("inked.blur")


def test_settings_are_no_code_and_the_library_is():
    names = set(code_digests("stages.base"))
    assert {"stages.base", "stages.errors", "svim3d.io.weights"} <= names
    assert not any(name.startswith("stages.settings") for name in code_digests("stages.generation"))


def test_what_only_tables_measure_by_makes_no_artifact_anew():
    reached = {name for name in code_digests("stages.dmtet") if name.startswith("svim3d.metrics.")}
    names = ("directions", "pictures", "surface_search", "volumes")
    assert reached == {f"svim3d.metrics.{name}" for name in names}


def test_missing_module_is_named():
    with pytest.raises(ModuleNotFoundError, match=r"stages\.juggling"):
        code_digests("stages.juggling")


@pytest.mark.parametrize(
    "change",
    [
        {"stage": "sharpen"},
        {"config": {"radius": 3}},
        {"seed": 1},
        {"inputs": {"source": "none"}},
        {"code": {"m": "e"}},
        {"versions": {"torch": "3"}},
    ],
)
def test_every_part_of_a_recipe_is_in_its_key(change):
    assert dataclasses.replace(RECIPE, **change).key != RECIPE.key


def test_key_ignores_the_order_of_names():
    one = dataclasses.replace(RECIPE, config={"a": 1, "b": 2})
    two = dataclasses.replace(RECIPE, config={"b": 2, "a": 1})
    assert one.key == two.key


def test_versions_leave_out_the_build():
    assert all("+" not in version for version in library_versions().values())


def test_folder_digest_is_its_names_and_contents(tmp_path):
    folder = tmp_path / "orbit"
    (folder / "views").mkdir(parents=True)
    (folder / "orbit.json").write_text("{}")
    (folder / "views" / "0.exr").write_bytes(b"0")
    first = digest_input(folder)
    (folder / ".DS_Store").write_bytes(b"noise")
    assert digest_input(folder.rename(tmp_path / "moved")) == first
    (tmp_path / "moved" / "views" / "0.exr").rename(tmp_path / "moved" / "views" / "1.exr")
    assert digest_input(tmp_path / "moved") != first


def test_mesh_digest_covers_the_files_that_it_names(tmp_path):
    mesh = tmp_path / "chair.obj"
    mesh.write_text("mtllib chair.mtl\n")
    (tmp_path / "chair.mtl").write_text("map_Kd wood.png\n")
    (tmp_path / "wood.png").write_bytes(b"brown")
    (tmp_path / "notes.txt").write_text("buy milk")
    first = digest_input(mesh)
    (tmp_path / "notes.txt").write_text("milk bought")
    assert digest_input(mesh) == first
    (tmp_path / "wood.png").write_bytes(b"red")
    assert digest_input(mesh) != first


@pytest.mark.parametrize("spelling", ["rust 1ä.png", "rust%201%C3%A4.png", "rust 1\\u00e4.png"])
def test_mesh_digest_covers_files_by_any_spelling_of_their_name(tmp_path, spelling):
    mesh = tmp_path / "chair.gltf"
    mesh.write_text(f'{{"images": [{{"uri": "{spelling}"}}]}}', encoding="utf-8")
    (tmp_path / "rust 1ä.png").write_bytes(b"brown")
    first = digest_input(mesh)
    (tmp_path / "rust 1ä.png").write_bytes(b"red")
    assert digest_input(mesh) != first


def test_absent_input_is_refused(tmp_path):
    with pytest.raises(
        InputError, match="does not exist; give a photo, an orbit folder, a mesh or a scene file"
    ):
        digest_input(tmp_path / "nowhere")


def test_frame_has_another_digest_when_its_camera_moves(tmp_path):
    (tmp_path / "train").mkdir()
    frame = tmp_path / "train" / "000.exr"
    frame.write_bytes(b"pixels")
    alone = digest_input(frame)
    (tmp_path / "orbit.json").write_text("{}")
    listed = digest_input(frame)
    (tmp_path / "orbit.json").write_text('{"fov": 2}')
    assert len({alone, listed, digest_input(frame)}) == 3
