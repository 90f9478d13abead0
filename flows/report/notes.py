"""What stages tell of in a word, said so that somebody can act on it."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from enum import StrEnum


class Grade(StrEnum):
    """How much a note should weigh with its reader."""

    ACT = "Look at this"
    MENDED = "Mended or left out"
    CHOSEN = "Chosen on the way"


@dataclass(frozen=True)
class Advice:
    """A kind of event.

    Attributes:
        grade: how much it weighs.
        title: what happened, in a few words.
        advice: what to do, or why nothing need be done.
    """

    grade: Grade
    title: str
    advice: str


@dataclass(frozen=True)
class Note:
    """Events of one kind in one run.

    Attributes:
        kind: the word for programs.
        advice: what it means.
        messages: what was said, by stage, in order.
    """

    kind: str
    advice: Advice
    messages: list[tuple[str, str]] = field(default_factory=list)


def _act(title: str, advice: str) -> Advice:
    return Advice(Grade.ACT, title, advice)


def _mended(title: str, advice: str) -> Advice:
    return Advice(Grade.MENDED, title, advice)


def _chosen(title: str, advice: str) -> Advice:
    return Advice(Grade.CHOSEN, title, advice)


CAPACITY = "capacity"  # has a table of its own
MORE_VIEWS = "Where the photo says too little, give an orbit of views of the real object."
ADVICE: Mapping[str, Advice] = {
    # The asset as a whole.
    "views_disagree": _act(
        "The asset does not show what the views do",
        "The views contradict each other, or hold what an asset cannot. Compare view and asset "
        "below: where all views are blurred, draw more orbits (--samples 4) or another --seed; "
        "where one is off, leave it out.",
    ),
    "views_bent": _act(
        "The views had to be moved to fit together",
        "Fine detail is lost where views were moved far. Of a photo: try --samples 4 or another "
        "--seed. Of your own orbit: check the cameras.",
    ),
    "warp_bound": _act(
        "Some views cannot be moved as far as they would have to be",
        "Check the cameras of these views, or leave the views out.",
    ),
    "view_outvoted": _act(
        "A view counts for less than the others",
        "Look at it below. If it is wrong, leave it out; symmetric things may set this off "
        "without harm.",
    ),
    "mask_outvoted": _act(
        "A mask fits none of the others",
        "It shapes nothing. Look at channel mask of this view; a mended mask brings its part back.",
    ),
    "inconsistent_masks": _act(
        "Masks contradict each other",
        "Thin parts may be missing or too thick. Check the masks of the views that were rejected.",
    ),
    "warp_reset": _mended(
        "A view's correction was begun anew", "Nothing to do, unless it happens to many views."
    ),
    # The photo.
    "plain_cut_out": _act(
        "The object was cut out by its plain background",
        "Check channel mask. A picture with transparency, or pip install 'svim3d[matting]', cuts "
        "out better.",
    ),
    "several_objects": _act(
        "Several objects are in the photo", "Crop it if only one of them is meant."
    ),
    "object_cut_off": _act(
        "The object leaves the photo", "Give a photo with some air around all of it."
    ),
    "photo_enlarged": _act("The object is small in the photo", "Give a larger photo."),
    "seen_through": _act(
        "Patches were taken for holes",
        "If they are none, give a picture with transparency, where they are opaque.",
    ),
    "opacity_ignored": _mended("The photo's transparency was left out", "As you asked for."),
    "specks_dropped": _mended(
        "Specks beside the object were left out", "Nothing to do, if they are no part of it."
    ),
    "shadow_removed": _mended(
        "A shadow was taken for background", "Check channel mask at the object's foot."
    ),
    "first_picture": _mended("The file holds several pictures", "The first of them is used."),
    "metadata_ignored": _mended(
        "The photo's metadata is damaged", "Turn the photo upright and save it again if it lies."
    ),
    "profile_ignored": _mended(
        "The photo's colour profile could not be used",
        "Colours were taken as sRGB: convert the photo to sRGB if they look wrong.",
    ),
    # The views.
    "few_views": _act("There are few views", MORE_VIEWS),
    "cut_off": _act("The object leaves the frame", "Frame it with a margin in every view."),
    "soft_masks": _act("Outlines fade", "They were sharpened about half: give sharper masks."),
    "no_textures": _chosen("There are no textures to write", "Phase 3 was left out."),
    "background_bleeds": _act(
        "The background shines through along outlines",
        "Colours there are taken from inside. Cut the object out cleanly.",
    ),
    "clipped_highlights": _act(
        "Highlights are cut off",
        "The light comes out too dim. Give radiance (.exr) from before it was clipped.",
    ),
    "glaring_pixels": _act(
        "Some pixels are far too bright", "They lead the light astray if they are noise: mend them."
    ),
    "dark_basecolor": _act(
        "Most of the object is very dark",
        "Only highlights tell how rough it is, and what lights it. Check roughness and metallic.",
    ),
    "mirror_like": _act(
        "Much of the object is a mirror",
        "What it reflects may end in its basecolor. Check channel basecolor for reflections.",
    ),
    "grazing_views": _act("Some sides are seen at grazing angles only", MORE_VIEWS),
    "colour_space": _act(
        "A transfer curve may be missing or applied twice",
        "Radiance and basecolor of an orbit are linear: check how they were written.",
    ),
    "non_finite_pixels": _mended(
        "Pixels without a number were filled from their neighbours",
        "Find out who wrote them if there are many.",
    ),
    "clamped": _mended(
        "Values out of range were clamped", "Check how these channels were written."
    ),
    "depth_dropped": _mended("Depths without a meaning were dropped", "Nothing to do."),
    "normals_rescaled": _mended("Normals were brought to unit length", "Nothing to do."),
    "view_dropped": _mended("A view shows nothing and was left out", "Check its mask."),
    "camera_assumed": _mended(
        "A frame's camera is not known", "Keep the orbit's orbit.json beside the frame."
    ),
    "clipped": _mended(
        "Values too large for the file were cut off", "Check what is that bright; scale it down."
    ),
    "edit": _chosen("Materials were changed as asked", "See edits.json."),
    "no_depth": _mended("The views carry no depth", "Nothing casts a shadow."),
    # Lights.
    "light_mended": _mended("The light held values that are none", "Check the file."),
    "light_dark": _act("The light is dark", "Check the file, or brighten it."),
    "light_layout": _mended(
        "The light's layout was guessed", "Give --layout if it looks turned or stretched."
    ),
    "ldr_light": _act(
        "The light has no highlights", "Pictures of 8 bits end at white: give an .exr or .hdr file."
    ),
    # Faults that were survived.
    "out_of_memory": _mended(
        "Memory ran out, and the work went on in smaller pieces",
        "Run fewer things at a time, or a smaller preset, if it happens often.",
    ),
    "io_fault": _mended("Files could not be read or written, then could", "Check disk and mount."),
    "transient_fault": _mended("Something was busy and was tried again", "Nothing to do."),
    "timeout": _mended("A stage was stopped by its time limit and tried again", "Raise --timeout."),
    "resumed": _mended("Work went on from a checkpoint", "The result is as if nothing happened."),
    "damaged_checkpoint": _mended("A damaged checkpoint was left out", "It cost time only."),
    "non_finite_step": _mended(
        "Steps without a finite loss were skipped", "A few do no harm; many end the stage."
    ),
    # What was chosen.
    "sample_chosen": _chosen(
        "One of several drawn orbits was kept", "Channel confidence shows where they agreed."
    ),
    CAPACITY: _chosen("Sizes follow from the views", "See the table of sizes below."),
    "plateau": _chosen("Steps were left out that gained nothing", "Set least_fall to 0 for all."),
    "faces": _chosen("As many triangles as the views can tell apart", "uv_bake.max_faces bounds."),
    "material": _chosen(
        "Each map in the smallest form that the views do not refuse",
        "uv_bake.materials=texture keeps full pictures.",
    ),
    "mesh": _mended("The surface was cleaned", "Check the outline below if much was removed."),
    "atlas": _mended(
        "The atlas was made by the simple method",
        "Seams are more and texels fewer; --force uv_bake on an idle machine tries again.",
    ),
    "lod": _chosen("Coarser levels were written", "They lie beside the asset in export/files."),
    "no_lpips": _mended(
        "Pictures were compared by structure, for want of LPIPS weights",
        "Give nerf.perceptual_weights.",
    ),
    "model_reduced": _chosen(
        "This page turns a smaller copy of the asset", "asset.glb beside it is the whole one."
    ),
    "model_left_out": _chosen(
        "The asset is too large for this page", "Open asset.glb beside it in any glTF viewer."
    ),
}
UNKNOWN = _mended("Told by a stage", "See its message.")
FAILED_ATTEMPT = "attempt"  # of a stage, as the run's record has it: a line without a kind
ATTEMPT = _act("An attempt failed", "Passing faults are tried again; the log has all of it.")


def grouped(events: Iterable[tuple[str, str, str]]) -> dict[Grade, list[Note]]:
    """Notes by grade, each kind once, in the order in which they came up.

    Args:
        events: stage, kind and message.
    """
    notes: dict[str, Note] = {}
    for stage, kind, message in events:
        advice = ATTEMPT if kind == FAILED_ATTEMPT else ADVICE.get(kind, UNKNOWN)
        note = notes.setdefault(kind, Note(kind, advice))
        if (stage, message) not in note.messages:
            note.messages.append((stage, message))
    found: dict[Grade, list[Note]] = {
        grade: [n for n in notes.values() if n.advice.grade is grade] for grade in Grade
    }
    return {grade: list_ for grade, list_ in found.items() if list_}


WITHOUT = {
    "prepare": "the input is no photo: nothing had to be cut out",
    "capacity": "sizes are those of the settings, whatever the views show",
    "env_preopt": "phase 1 started from an even grey light instead of a fitted one",
    "dmtet": "the surface is phase 1's own grid: softer edges, no refinement on whole images",
    "uv_bake": "materials are painted per vertex: no textures, one roughness for all",
    "preview": "there are no figures of how well the asset shows the views",
}

FAULTS = {
    "InputError": "The input cannot be used as it is. The message says what was wanted, what came "
    "and what to do; mend that and give the command again.",
    "DivergenceError": "The fit went astray. Lower the learning rate that the message names, or "
    "try another --seed; check the views below for NaN, wrong masks or cameras first.",
    "FullError": "The disk is full. Free some space (svim3d store gc helps), then resume.",
    "TransientError": "Something the run needs was away for a while. Resume when it is back.",
    "OutOfMemoryError": "Memory ran out in spite of smaller pieces. Use a smaller preset, or a "
    "machine with more of it; resume goes on from the last checkpoint.",
    "MemoryError": "Memory ran out in spite of smaller pieces. Use a smaller preset, or a machine "
    "with more of it; resume goes on from the last checkpoint.",
    "StageTimeoutError": "A stage ran into its --timeout. Resume goes on from its last checkpoint.",
}
OTHER_FAULT = (
    "This is no fault of your input that we know of. Resume once: finished stages stay. If it "
    "fails again, run the command with --debug and report what it prints."
)


def remedy(error: str) -> str:
    """What to do about a run's error, which begins with the name of its kind."""
    return FAULTS.get(error.partition(":")[0].strip(), OTHER_FAULT)
