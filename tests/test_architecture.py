"""The house rules, read off the syntax trees: who imports whom, and how long things may be.

The tables here are the rules' only copy.
"""

import ast
from collections.abc import Iterator
from pathlib import Path

import pytest

PROJECT = Path(__file__).resolve().parents[1]
FLOORS = ("flows", "stages", "svim3d")
MAX_FILE_LINES, MAX_FUNCTION_LINES = 400, 60

# Who may import what of ours. The longest matching prefix counts; a module may always import what
# lies in its own package, except a stage, which knows no other stage.
BASICS = ("svim3d.numerics", "svim3d.color", "svim3d.compiled")
MIDDLE = (
    "cameras",
    "optim",
    "losses",
    "metrics",
    "shading",
    "fields",
    "raster",
    "mesh",
    "diffusion",
)
TIER_1 = tuple(f"svim3d.{name}" for name in MIDDLE)
CONTRACT = (
    "stages.base",
    "stages.artifacts",
    "stages.capacity_plan",
    "stages.photo_artifact",
    "stages.picture_networks",
    "stages.pair_distance",
    "stages.picture_sets",
    "stages.orb_scores",
    "stages.orbit_drawing",
    "stages.errors",
    "stages.export_checks",
    "stages.export_formats",
    "stages.finished_views",
    "stages.nerf_hull",
    "stages.nerf_terms",
    "stages.perceptual_terms",
    "stages.plateau",
    "stages.prefilter_cache",
    "stages.preview_bounds",
    "stages.subject",
    "stages.truth",
    "stages.training_batches",
    "stages.precision",
    "stages.scores_artifact",
    "stages.set_figures",
    "stages.settings",
    "stages.view_remedies",
)
MAY_IMPORT = {
    "svim3d": BASICS,
    "svim3d.render": (*BASICS, *TIER_1),
    "svim3d.synthesis": (*BASICS, *TIER_1, "svim3d.render"),
    "svim3d.io": (*BASICS, *TIER_1, "svim3d.synthesis.example"),
    "svim3d.charts": (*BASICS, *TIER_1),
    "stages": ("svim3d", *CONTRACT),
    "stages.installed": (),
    "stages.settings": ("stages.settings", "stages.installed"),
    "stages.errors": (),
    "stages.base": ("svim3d", "stages.errors"),
    "stages.artifacts": ("svim3d",),
    "stages.capacity_plan": ("svim3d", "stages.base", "stages.settings"),
    "stages.photo_artifact": ("svim3d",),
    "stages.pair_distance": ("svim3d",),
    "stages.picture_networks": ("svim3d", "stages.errors", "stages.set_figures"),
    "stages.picture_sets": ("svim3d", "stages.set_figures"),
    "stages.orb_scores": (
        "svim3d",
        "stages.pair_distance",
        "stages.scores_artifact",
        "stages.truth",
    ),
    "stages.orbit_drawing": ("svim3d", *CONTRACT),
    "stages.export_checks": ("svim3d", "stages.artifacts"),
    "stages.export_formats": ("svim3d", *CONTRACT),
    "stages.finished_views": ("svim3d", *CONTRACT),
    "stages.keys": ("stages.errors",),
    "stages.prefilter_cache": ("svim3d", "stages.keys"),
    "stages.nerf_hull": ("svim3d", *CONTRACT),
    "stages.perceptual_terms": ("svim3d", *CONTRACT),
    "stages.nerf_terms": ("svim3d", "stages.settings", "stages.view_remedies"),
    "stages.manifest": ("stages.keys",),
    "stages.store": ("stages.keys", "stages.manifest", "stages.errors"),
    "stages.locks": (),
    "stages.scores_artifact": ("svim3d",),
    "stages.set_figures": ("svim3d", "stages.scores_artifact"),
    "stages.plateau": ("svim3d", "stages.base", "stages.settings"),
    "stages.precision": ("stages.settings",),
    "stages.preview_bounds": (),
    "stages.view_remedies": ("svim3d", "stages.base", "stages.settings"),
    "stages.given_views": ("svim3d", "stages.artifacts", "stages.errors", "stages.keys"),
    "stages.invented_orbit": ("svim3d", "stages.keys"),
    "stages.store_cleaning": ("stages.store", "stages.locks", "stages.errors"),
    "stages.store_archive": (
        "stages.store",
        "stages.store_cleaning",
        "stages.locks",
        "stages.manifest",
        "stages.errors",
    ),
    "stages.shared_store": ("stages.store", "stages.keys", "stages.manifest", "stages.errors"),
    "stages.faults": ("stages.errors", "stages.store"),
    "stages.suites": ("svim3d", "stages.keys", "stages.errors"),
    "stages.time_limit": ("stages.errors",),
    "stages.device_slot": (),
    "stages.execution": (
        *CONTRACT,
        "stages.keys",
        "stages.store",
        "stages.faults",
        "stages.time_limit",
        "stages.device_slot",
    ),
    "flows": ("flows", "stages"),
    "flows.chart": ("flows", "stages", "svim3d.charts"),
    # What strangers send is looked at before a stage, which loads torch, sees it.
    "flows.service": ("flows", "stages", "svim3d.io.exr", "svim3d.io.photo_header"),
}
# Inside svim3d a unit of the middle tier sees itself and the basics.
UNITS = {name: f"svim3d.{name}" for name in (*MIDDLE, "render", "synthesis", "io")}

# One library, one door.
DOORS = {
    "prefect": ("flows",),
    "prefect_dask": ("flows.batch_flow",),
    "prefect_ray": ("flows.batch_flow",),
    "fsspec": ("stages.shared_store",),
    "cloudpickle": ("flows.workers",),
    "uvicorn": ("flows.engine_server", "flows.service.serve"),
    "fastapi": ("flows.service",),
    "starlette": ("flows.service",),
    "rich": ("flows",),
    "jinja2": ("flows.report.template",),
    "viser": ("flows.view",),
    "pydantic": ("flows", "stages.settings"),
    "yaml": ("flows",),
    "OpenEXR": ("svim3d.io.exr",),
    "safetensors": ("svim3d.io.weights",),
    "PIL": ("svim3d.io.image", "svim3d.io.photo", "svim3d.io.photo_header", "svim3d.io.thumbnail"),
    "pxr": ("svim3d.io.usd",),
    "DracoPy": ("svim3d.io.draco",),
    "onnxruntime": ("svim3d.io.matting_network",),
    "imageio_ffmpeg": ("svim3d.io.animation",),
    # A script for an interpreter of its own: nothing imports it.
    "bpy": ("svim3d.io.cycles_scene",),
    "mathutils": ("svim3d.io.cycles_scene",),
    "trimesh": ("svim3d.io.glb", "svim3d.io.obj", "svim3d.io.triangles", "svim3d.io.suites"),
    "matplotlib": ("svim3d.charts",),
    "xatlas": ("svim3d.mesh.xatlas_process",),
    "mitsuba": ("svim3d.render.path_tracing",),
    "pymeshlab": ("svim3d.mesh.cleanup",),
    "fast_simplification": ("svim3d.mesh.cleanup",),
    "numba": ("svim3d",),
    "scipy": ("svim3d",),
    "kornia": ("svim3d",),
    "diffusers": ("svim3d.diffusion",),
    "transformers": ("svim3d.diffusion", "svim3d.io.picture_networks"),
    "torch": ("svim3d", "stages", "flows"),
    "numpy": ("svim3d", "stages"),
    "jaxtyping": ("svim3d", "stages"),
}
# What a plan and `--help` load: no torch, no Prefect at the top of these modules.
LIGHT = (
    "flows.batch",
    "flows.batch_inputs",
    "flows.batch_job",
    "flows.batch_options",
    "flows.batch_results",
    "flows.cases",
    "flows.chart",
    "flows.chart_front",
    "flows.chart_knobs",
    "flows.chart_options",
    "flows.chart_page",
    "flows.chart_points",
    "flows.chart_table",
    "flows.workers",
    "flows.cli",
    "flows.commands",
    "flows.config",
    "flows.console",
    "flows.data",
    "flows.data_options",
    "flows.edit",
    "flows.export",
    "flows.engine",
    "flows.evaluate",
    "flows.evaluate_cases",
    "flows.evaluate_files",
    "flows.evaluate_options",
    "flows.evaluate_orb",
    "flows.evaluate_paper",
    "flows.evaluate_sets",
    "flows.evaluate_tables",
    "flows.hooks",
    "flows.job",
    "flows.limits",
    "flows.model",
    "flows.model_options",
    "flows.operator_options",
    "flows.options",
    "flows.pipeline",
    "flows.plan",
    "flows.processes",
    "flows.recording",
    "flows.relight",
    "flows.report",
    "flows.report_options",
    "flows.run_folder",
    "flows.run_records",
    "flows.runs",
    "flows.scoring",
    "flows.stability",
    "flows.stability_cases",
    "flows.stability_figures",
    "flows.stability_options",
    "flows.stability_report",
    "flows.stability_table",
    "flows.stopping",
    "flows.store",
    "flows.serve",
    "flows.serve_options",
    "flows.service",
    "flows.view",
    "stages.errors",
    "stages.keys",
    "stages.locks",
    "stages.manifest",
    "stages.preview_bounds",
    "stages.shared_store",
    "stages.store",
    "stages.store_archive",
    "stages.store_cleaning",
    "stages.settings",
)
HEAVY = {"torch", "prefect", "numba", "kornia", "scipy", "stages.base", "stages.execution"}

# The library computes: it meets no files (io apart), clocks, environment or global state.
UNSEEN_BY_LIBRARY = {"os", "pathlib", "random", "time", "logging", "argparse", "shutil", "tempfile"}
FILE_DOORS = ("svim3d.io", "svim3d.charts")
GLOBAL_RANDOMNESS = {"torch.manual_seed", "numpy.random", "np.random.seed", "random.random"}


def modules() -> dict[str, Path]:
    """Dotted names and files of all our source."""
    found = {}
    for floor in FLOORS:
        for file in sorted((PROJECT / floor).rglob("*.py")):
            parts = file.relative_to(PROJECT).with_suffix("").parts
            found[".".join(parts[:-1] if parts[-1] == "__init__" else parts)] = file
    return found


MODULES = modules()
TREES = {name: ast.parse(file.read_text()) for name, file in MODULES.items()}


def is_within(name: str, prefixes: tuple[str, ...] | frozenset[str] | set[str]) -> bool:
    return any(name == prefix or name.startswith(f"{prefix}.") for prefix in prefixes)


def imports(nodes: Iterator[ast.AST]) -> Iterator[str]:
    """Modules named by import statements; `from a import b` names `a.b` where that is a module."""
    for node in nodes:
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            base = node.module or ""
            for alias in node.names:
                full = f"{base}.{alias.name}"
                yield full if full in MODULES else base


def top_level(tree: ast.Module) -> Iterator[ast.AST]:
    """Statements that run on import: not those for type checkers, not those inside functions."""
    for node in tree.body:
        is_for_types = isinstance(node, ast.If) and "TYPE_CHECKING" in ast.dump(node.test)
        if not is_for_types:
            yield node


def permitted(module: str) -> tuple[str, ...]:
    """What `module` may import of ours."""
    rule = max((p for p in MAY_IMPORT if is_within(module, (p,))), key=len)
    unit = ".".join(module.split(".")[:2])
    own = (unit,) if unit in UNITS.values() or rule.startswith("stages.settings") else ()
    return (*MAY_IMPORT[rule], *own)


@pytest.mark.parametrize("module", MODULES)
def test_imports_point_down(module):
    ours = {name for name in imports(ast.walk(TREES[module])) if name.partition(".")[0] in FLOORS}
    assert not {name for name in ours if not is_within(name, permitted(module))}


@pytest.mark.parametrize("module", MODULES)
def test_each_library_has_one_door(module):
    used = {name.partition(".")[0] for name in imports(ast.walk(TREES[module]))}
    assert not {name for name in used & set(DOORS) if not is_within(module, DOORS[name])}


@pytest.mark.parametrize("module", [m for m in MODULES if is_within(m, LIGHT)])
def test_planning_stays_light(module):
    loaded = {module}
    queue = [module]
    while queue:
        for name in imports(top_level(TREES[queue.pop()])):
            assert not is_within(name, HEAVY), f"{module} loads {name}"
            if name in MODULES and name not in loaded:
                loaded.add(name)
                queue.append(name)


@pytest.mark.parametrize("module", [m for m in MODULES if is_within(m, ("stages.settings",))])
def test_settings_hold_values_and_compute_nothing(module):
    # They are left out of the code in an artifact's key: a formula here could change unseen.
    for node in ast.walk(TREES[module]):
        if isinstance(node, ast.FunctionDef):
            checks = {"field_validator", "model_validator"}
            decorators = {ast.unparse(d).partition("(")[0] for d in node.decorator_list}
            assert decorators & checks, f"{module}.{node.name} belongs into the stage"


@pytest.mark.parametrize("module", [m for m in MODULES if is_within(m, ("svim3d",))])
def test_library_sees_tensors_only(module):
    if not is_within(module, FILE_DOORS):
        used = {name.partition(".")[0] for name in imports(ast.walk(TREES[module]))}
        assert not used & UNSEEN_BY_LIBRARY
    calls = [node for node in ast.walk(TREES[module]) if isinstance(node, ast.Call)]
    names = {ast.unparse(call.func) for call in calls}
    assert "print" not in names
    assert not {name for name in names if is_within(name, GLOBAL_RANDOMNESS)}


@pytest.mark.parametrize("module", MODULES)
def test_files_and_functions_stay_short(module):
    assert len(MODULES[module].read_text().splitlines()) <= MAX_FILE_LINES
    for node in ast.walk(TREES[module]):
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            code = node.end_lineno - node.lineno + 1 - _docstring_lines(node)
            assert code <= MAX_FUNCTION_LINES, f"{node.name} has {code} lines"


def _docstring_lines(node: ast.FunctionDef | ast.AsyncFunctionDef) -> int:
    if ast.get_docstring(node) is None:
        return 0
    return node.body[0].end_lineno - node.body[0].lineno + 1


def test_every_module_is_judged():
    assert {"flows.cli", "stages.store", "svim3d.numerics"} <= set(MODULES)
