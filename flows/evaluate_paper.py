"""What others report, beside the tables whose figures they can be laid beside.

Figures stand beside ours only where the protocol is told and is the same. The paper names no mask,
scale, range or alignment for its pictures, so its figures are named as of another protocol.
"""

OTHER = "other protocol, not to be compared"
PAPER = "SViM3D (ICCV 2025)"

_PAPER = {
    ("poly-haven", "materials"): f"{PAPER}: basecolor 28.68 dB, SSIM 0.92, LPIPS 0.037 ({OTHER}: "
    "its mask and scale are not told).",
    ("poly-haven", "views"): f"{PAPER}: novel views 19.57 dB; relit in 2.5D 19.99 dB, SSIM 0.87, "
    f"LPIPS 0.089 ({OTHER}).",
    ("stanford-orb", "relighting"): f"{PAPER}: novel views 19.34 dB, SSIM 0.80; relit 21.86 dB, "
    f"SSIM 0.90 ({OTHER}: an SSIM of the benchmark's own script would lie above 0.95).",
    ("gso", "geometry"): f"{PAPER}: Chamfer 0.034, IoU 0.48; SF3D: 0.137, F at 0.1 0.540; SPAR3D: "
    f"0.120, F at 0.1 0.584 ({OTHER}: other scales, and samples measured to samples).",
}
_ORB = (
    "Official rows of others, by the benchmark's script, relit PSNR-H / PSNR-L / SSIM: IDArb from "
    "one view, the same view rendered again (easier) 24.11 / 31.28 / 0.969; RelitLRM from 6 views "
    "24.67 / 31.52 / 0.969; nvdiffrecmc from all views 24.43 / 31.60 / 0.972; nvdiffrecmc given "
    "the true mesh and material 25.08 / 32.28 / 0.974. Ours is made of one photo and seen from "
    "novel views: the rules are the same, the input is not.",
    "The official script forgives: means run over the black background too, a scale is fitted per "
    "picture and channel, and no PSNR counts below a constant picture's. A capture without an "
    "asset is scored as white pictures, which costs little by these rules: mind the column of "
    "failures.",
)


def notes_for(suite: str, table: str) -> list[str]:
    """What is told below a table."""
    if (suite, table) == ("stanford-orb", "stanford-orb"):
        return list(_ORB)
    told = _PAPER.get((suite, table))
    return [told] if told else []
