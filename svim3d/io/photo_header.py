"""What a picture file says of itself, read without decoding it: format and size.

Loads Pillow alone, so that a process which only receives photos stays small.
"""

import warnings
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

from PIL import Image, UnidentifiedImageError

# Named, because other decoders of Pillow start programs or fetch things. Each with the ending that
# a file of it should have.
FORMATS = {
    "PNG": ".png",
    "JPEG": ".jpg",
    "WEBP": ".webp",
    "TIFF": ".tif",
    "BMP": ".bmp",
    "GIF": ".gif",
}


@runtime_checkable
class Readable(Protocol):
    """Bytes that can be read from any place: a file, a buffer, an upload."""

    def read(self, size: int = -1, /) -> bytes:
        """The next bytes."""

    def seek(self, offset: int, whence: int = 0, /) -> int:
        """Go to a place."""

    def tell(self) -> int:
        """Tell the place."""


@dataclass(frozen=True)
class PhotoHeader:
    """What a picture file claims.

    Attributes:
        suffix: the usual ending of a file of its format, with the dot.
        height: rows.
        width: columns.
    """

    suffix: str
    height: int
    width: int


def read_photo_header(stream: Readable) -> PhotoHeader:
    """Format and size of a picture; its pixels are not touched, whatever size they claim.

    Args:
        stream: seekable, at the file's first byte; left anywhere.

    Raises:
        ValueError: the bytes begin no picture of a known format.
    """
    try:
        with warnings.catch_warnings():
            # Sizes are judged by whoever asked.
            warnings.simplefilter("ignore")
            picture = Image.open(stream, formats=tuple(FORMATS))
            width, height = picture.size
    except Image.DecompressionBombError as error:
        raise ValueError(f"the file claims a huge size ({error}); scale it down") from error
    except UnidentifiedImageError as error:
        raise ValueError("the bytes begin no picture of a known format") from error
    except Exception as error:  # of any kind: decoders raise whatever damaged bytes lead them to
        raise ValueError(f"the head of the picture is damaged ({type(error).__name__})") from error
    return PhotoHeader(FORMATS[str(picture.format)], height, width)
