"""What a caller of the service may ask of this machine."""

from dataclasses import dataclass

MIB = 1 << 20


@dataclass(frozen=True)
class Limits:
    """Bounds that a request meets before anything is done for it.

    Attributes:
        upload_bytes: of a whole request; counted while it arrives.
        upload_s: in which it must have arrived.
        photo_px: that a picture may claim.
        queue: jobs that wait or arrive; beyond it callers are sent away for a while.
        timeout_s: in which a job must be done, from each start.
        keep_s: after which a finished job and its files are removed.
    """

    upload_bytes: int = 64 * MIB  # an orbit of 21 views at 512 x 512 pixels takes 30 MiB
    upload_s: float = 300.0
    photo_px: int = 1 << 26  # telephones take up to 50 million; decoded 268 MB
    queue: int = 32
    timeout_s: float = 4 * 3600.0
    keep_s: float = 72 * 3600.0


@dataclass(frozen=True)
class ArchiveLimits:
    """What a .zip of views may hold. Its bombs are many entries, high ratios and huge views.

    Attributes:
        entries: in its directory.
        unpacked_bytes: of all entries together.
        ratio: of an entry's size to its packed size; OpenEXR files are packed in themselves.
        index_bytes: of `orbit.json`.
        views: frames in `orbit.json`.
        view_px: rows or columns of a view.
        values: numbers in all views together, as their headers claim; 4 bytes each once decoded.
    """

    entries: int = 512
    unpacked_bytes: int = 512 * MIB
    ratio: int = 200
    index_bytes: int = 2 * MIB
    views: int = 200
    view_px: int = 2048
    values: int = 1 << 29  # 2 GiB decoded: 21 views of 1024 x 1024 with 13 channels take 1.1
