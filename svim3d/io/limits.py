"""What a picture file may claim before memory is set aside for it."""

MAX_PICTURE_TEXELS = 1 << 27  # 16384 x 8192; as float32 RGB 1.6 GB


def check_size(height: int, width: int) -> None:
    """Refuse sizes that are empty or beyond reason.

    Raises:
        ValueError: says the size and the limit.
    """
    if height < 1 or width < 1:
        raise ValueError(f"wanted a picture, got one of {height} x {width} pixels")
    if height * width > MAX_PICTURE_TEXELS:
        raise ValueError(
            f"wanted at most {MAX_PICTURE_TEXELS} pixels, but the file claims {height} x {width}; "
            "scale it down"
        )
