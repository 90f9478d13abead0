"""The chart's page in a browser: points are drawn, told of, and laid against other axes."""

import json
import re
import shutil
import subprocess
from dataclasses import replace

import pytest

from flows.chart_page import write_page
from flows.chart_points import Case, points_of
from flows.chart_table import rows_of, summarised

BROWSERS = ("chromium", "chromium-browser", "google-chrome")
SWITCHES = (
    *("--headless", "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run"),
    *("--disable-background-networking", "--disable-component-update", "--disable-sync"),
)


def page_of(folder):
    """A page of four points on two orbits; the third and fourth are worse and dearer."""
    points = points_of("preview", ("standard", "paper"), (), scales=(2.0,))
    points[1] = replace(points[1], about="</script><b>")
    results = {
        Case(point.name, orbit, 0): {
            "outcome": "asset",
            "costs": {"cpu_s": cost, "seconds": cost, "peak_mib": 900.0, "bytes": 2e6},
            "figures": {
                "relight_delta_db": -offset - number % 3,
                "normal_deg": 4.0,
                "distance": 0.002 * (1 + number),
                "basecolor_db": 25.0,
            },
        }
        for number, (point, cost) in enumerate(zip(points, (10.0, 80.0, 300.0, 15.0), strict=True))
        for orbit, offset in (("<pot>", 0.0), ("cup", 3.0))
    }
    summary = summarised(points, ["<pot>", "cup"], results)
    file = folder / "chart.html"
    write_page(summary, rows_of(summary), ["made up for `<pot>`, </style>"], b"<svg></svg>", file)
    return file


def test_names_and_settings_cannot_write_the_page(tmp_path):
    text = page_of(tmp_path).read_text()
    assert "<pot>" not in text
    assert "<b>" not in text
    assert (text.count("</script>"), text.count("</style>")) == (2, 1)
    assert "made up for <code>&lt;pot&gt;</code>, &lt;/style&gt;" in text


@pytest.mark.browser
def test_points_answer(tmp_path):
    browser = next((found for name in BROWSERS if (found := shutil.which(name))), None)
    if browser is None:
        pytest.skip("no Chromium")
    file = page_of(tmp_path)
    # Choose another quality, hide a group, focus the last point, order the table by CPU seconds.
    drive = """
    const y = document.getElementById('y');
    y.value = 'distance'; y.dispatchEvent(new Event('change'));
    document.querySelector('#legend input').click();
    [...document.querySelectorAll('.point')].at(-1).focus();
    document.querySelectorAll('th button')[1].click();
    document.querySelectorAll('th button')[1].click();
    """
    page = file.read_text()
    file.write_text(page.replace("</body>", f'<script type="module">{drive}</script></body>'))
    command = [browser, *SWITCHES, f"--user-data-dir={tmp_path / 'profile'}", "--dump-dom"]
    done = subprocess.run(
        [*command, file.as_uri()], capture_output=True, text=True, timeout=120, check=True
    )
    shown = done.stdout
    groups = json.loads(re.search(r'id="data">(.*?)</script>', shown, re.S).group(1))["groups"]
    assert groups == ["presets", "scale"]
    chart = shown[shown.index('id="chart"') : shown.index('id="legend"')]
    assert chart.count('class="point"') == 1  # presets are hidden
    assert "surface distance" in chart
    told = shown[shown.index('id="told"') :]
    assert "steps x2" in told[: told.index("</section>")]
    body = shown[shown.index("<tbody>") : shown.index("</tbody>")]
    assert shown.count('aria-sort="descending"') == 1
    assert re.findall(r'<th scope="row">(.*?)</th>', body) == [
        *("paper", "standard", "steps x2", "preview"),
    ]
