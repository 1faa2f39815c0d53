"""The site and a report in a real browser: nothing is clipped, missing or unreadable."""

import os
import subprocess
import sys

import pytest

from flytrack.cli import main
from tests.support.browser import open_browser
from tests.support.pages import ROOT

pytestmark = pytest.mark.slow

PAGES = (
    "index.html",
    "algorithm.html",
    "effects/command_delay.html",
    "effects/quadratic_drag.html",
    "effects/second_order_rates.html",
    "notebooks/quick_start.html",
    "results/index.html",
    "api/effects.html",
)
CLIPPED = """<!doctype html><style>math { display: block; overflow: hidden; height: 8px }
.wide { width: 3000px }</style><p class=wide>wide</p><img src="none.png" width=9>
<math><mfrac><mi>a</mi><mi>b</mi></mfrac></math>"""


@pytest.fixture(scope="module")
def browser():
    with open_browser() as opened:
        yield opened


@pytest.fixture(scope="module")
def site(browser, tmp_path_factory):
    """The site, built anew; a warning of the build is an error."""
    folder = tmp_path_factory.mktemp("site")
    words = [sys.executable, "-m", "mkdocs", "build", "--strict", "--quiet", "-d", str(folder)]
    env = {**os.environ, "NO_MKDOCS_2_WARNING": "1"}
    subprocess.run(words, cwd=ROOT, env=env, check=True)
    return folder


@pytest.fixture(scope="module")
def report(browser, tmp_path_factory):
    """The report of a diagnosis of a minute of the shipped black box."""
    folder = tmp_path_factory.mktemp("report")
    log = str(folder / "log.npz")
    main(["collect", "--minutes", "1", "--noise", "1", "--out", log])
    main(["diagnose", log, "--motion", "euler", "--out", str(folder / "diagnosis")])
    return folder / "diagnosis" / "report.html"


def test_what_is_clipped_is_found(browser, tmp_path):
    page = tmp_path / "clipped.html"
    page.write_text(CLIPPED, encoding="utf-8")
    browser.show(page)
    found = " ".join(browser.find_clipped(may_scroll=True))
    words = ("outside of the window: P", "missing: IMG", "cut below: MATH", "scrolls sideways")
    assert all(word in found for word in words), found


@pytest.mark.parametrize("zoom", [1.0, 1.5])
@pytest.mark.parametrize("name", PAGES)
def test_a_page_of_the_site_is_whole(browser, site, name, zoom):
    browser.show(site / name, zoom=zoom)
    assert not browser.find_clipped(may_scroll=True)


def test_a_report_shows_all_its_columns(browser, report):
    browser.show(report)
    assert not browser.find_clipped(may_scroll=False)
    browser.show(report, zoom=1.5)
    assert not browser.find_clipped(may_scroll=True)


@pytest.mark.parametrize("is_dark", [False, True])
def test_text_stands_out_in_light_and_dark(browser, site, report, is_dark):
    for page, selector in ((site / "index.html", "article p"), (report, "p.verdict, .verdict")):
        browser.show(page, is_dark=is_dark)
        assert browser.contrast(selector) > 4.5, page
