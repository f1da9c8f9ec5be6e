"""The report in a real browser: its script runs and no other, and it prints on a few pages."""

from __future__ import annotations

import re
import shutil
import subprocess
from pathlib import Path

import pytest
from helpers_scene import make_pair

from mtpcr_geo.export.report.page import write_report

NAMES = ("chromium", "chromium-browser", "google-chrome")
CHROMIUM = next((found for name in NAMES if (found := shutil.which(name))), None)
pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(CHROMIUM is None, reason="no Chromium is installed"),
]


def browser(folder: Path, *options: str) -> subprocess.CompletedProcess[str]:
    """Run Chromium without a window and with a profile of its own."""
    command = [
        str(CHROMIUM), "--headless=new", "--no-sandbox", "--disable-gpu", "--no-first-run",
        "--disable-background-networking", "--enable-logging=stderr", f"--user-data-dir={folder / 'profile'}",
        *options,
    ]  # fmt: skip
    return subprocess.run(command, capture_output=True, text=True, timeout=300, check=True)


@pytest.fixture(scope="module")
def page(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("report") / "report.html"
    pair = make_pair(60_000)
    pair.source.cloud.name = "<img src=x onerror=alert(1)>.laz"
    write_report(path, pair, [], {"versions": {}, "inputs": []})
    return path


def test_its_script_runs_and_no_other(page: Path, tmp_path: Path) -> None:
    done = browser(tmp_path, "--dump-dom", page.as_uri())
    assert 'class="swipe on"' in done.stdout  # by the page's own script, which its policy lets through
    assert "--at:50%" in done.stdout.replace(" ", "")
    assert "<img src=x" not in done.stdout
    assert "&lt;img src=x onerror=alert(1)&gt;.laz" in done.stdout
    # errors of scripts, and what the page's policy keeps from being fetched, are logged as from the console
    assert "CONSOLE" not in done.stderr, done.stderr


def test_it_prints_on_a_few_pages(page: Path, tmp_path: Path) -> None:
    printed = tmp_path / "report.pdf"
    browser(tmp_path, f"--print-to-pdf={printed}", "--no-pdf-header-footer", page.as_uri())
    pages = re.findall(rb"/Type\s*/Page\b(?!s)", printed.read_bytes())
    assert 2 <= len(pages) <= 4


@pytest.mark.parametrize("width", [1400, 800, 390])
def test_it_is_as_wide_as_the_window(page: Path, width: int, tmp_path: Path) -> None:
    import cv2

    shot = tmp_path / "shot.png"
    browser(
        tmp_path, f"--window-size={width},900", "--hide-scrollbars", f"--screenshot={shot}", page.as_uri()
    )
    picture = cv2.imread(str(shot))
    assert picture is not None
    assert picture.std() > 20.0
