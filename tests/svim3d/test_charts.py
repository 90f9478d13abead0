import io

import pytest
from PIL import Image

from svim3d.charts import COLUMNS, Mark, Panel, draw_panels, front_line


def test_the_front_goes_from_cheap_to_good():
    points = [(4.0, 2.0), (1.0, 1.0), (2.0, 0.5), (3.0, 2.0), (1.0, 0.9), (9.0, 3.0)]
    assert front_line(points, more_is_better=True) == [(1.0, 1.0), (3.0, 2.0), (9.0, 3.0)]
    assert front_line(points, more_is_better=False) == [(1.0, 0.9), (2.0, 0.5)]
    assert front_line([], more_is_better=True) == []


def panel(**changed):
    marks = [
        Mark("cheap", "presets", 10.0, 1.0, (0.8, 1.2), True, True),
        Mark("dear", "rays", 40.0, 2.0, (1.5, 2.5), True, True),
        Mark("hidden", "rays", 50.0, 1.5, (1.5, 1.5), False, False),
    ]
    given = {"is_log_y": False, "more_is_better": True} | changed
    return Panel("CPU s", "relit, dB", marks, **given)


def test_names_titles_and_groups_are_written_and_equal_pictures_are_equal_bytes():
    panels = [panel(), panel(is_log_y=True, more_is_better=False)]
    drawn = draw_panels(panels, "Speed & accuracy", "svg")
    text = drawn.decode()
    for word in ("cheap", "dear", "CPU s", "relit, dB", "Speed &amp; accuracy", "presets", "rays"):
        assert f">{word}</text>" in text or f"{word}</text>" in text, word
    assert "hidden" not in text
    assert draw_panels(panels, "Speed & accuracy", "svg") == drawn


@pytest.mark.parametrize("count", [1, COLUMNS + 1])
def test_any_number_of_panels_is_a_picture(count):
    picture = Image.open(io.BytesIO(draw_panels([panel()] * count, "title", "png")))
    assert picture.width > picture.height if count == 1 else picture.width > 1000
