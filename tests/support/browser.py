"""Pages in a real browser: headless Chromium, driven by Selenium."""

import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

CHROMIUM = ("chromium", "chromium-browser", "google-chrome")
FLAGS = ("--headless=new", "--no-sandbox", "--disable-gpu", "--allow-file-access-from-files")
# What a reader cannot see: content beyond its box or the window, and pictures that did not load.
# Code and wide tables may scroll sideways in a box of their own, and nothing may be cut vertically.
FIND_CLIPPED = """
const found = [];
const say = (what, element) => {
  const text = (element.src || element.textContent).trim().slice(0, 80);
  found.push(`${what}: ${element.tagName.toUpperCase()} ${text}`);
};
const all = "p, li, h1, h2, h3, table, math, img, figure, pre";
for (const element of document.querySelectorAll(all)) {
  const box = element.getBoundingClientRect();
  if (!box.width) continue;
  if (element.tagName === "IMG" && !element.naturalWidth) say("missing", element);
  const style = getComputedStyle(element);
  if (style.overflowY !== "visible" && element.scrollHeight > element.clientHeight + 1)
    say("cut below", element);
  if (SIDEWAYS.includes(element.tagName.toUpperCase()) && style.overflowX !== "visible"
      && element.scrollWidth > element.clientWidth + 1) say("cut at the right", element);
  const holder = element.closest(".scroll, .md-typeset__scrollwrap");
  if (box.right > innerWidth + 1 && !(holder && MAY_SCROLL)) say("outside of the window", element);
  if (holder && !MAY_SCROLL && holder.scrollWidth > holder.clientWidth + 1) say("scrolls", element);
}
if (document.documentElement.scrollWidth > innerWidth + 1) found.push("the page scrolls sideways");
return found;
"""
SHORT = '["MATH", "IMG", "P", "LI"]'


def chromium() -> str:
    """Return the path of Chromium; skips the test where there is none."""
    path = next(filter(None, map(shutil.which, CHROMIUM)), None)
    if path is None or shutil.which("chromedriver") is None:
        pytest.skip("found no chromium and chromedriver: apt-get install chromium chromium-driver")
    return path


@contextmanager
def open_browser() -> Iterator["Browser"]:
    """Open a browser and close it."""
    path = chromium()
    from selenium import webdriver
    from selenium.webdriver.chrome.service import Service

    options = webdriver.ChromeOptions()
    options.binary_location = path
    for flag in FLAGS:
        options.add_argument(flag)
    driver = webdriver.Chrome(options=options, service=Service(shutil.which("chromedriver")))
    try:
        yield Browser(driver)
    finally:
        driver.quit()


class Browser:
    """A window on pages of this machine."""

    def __init__(self, driver):
        self.driver = driver

    def show(self, page: Path, width: int = 1300, zoom: float = 1.0, is_dark: bool = False) -> None:
        """Load a page in a window of that width, its content enlarged by ``zoom``."""
        size = {"width": int(width / zoom), "height": int(1000 / zoom)}
        metrics = {**size, "deviceScaleFactor": zoom, "mobile": False}
        self.driver.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", metrics)
        scheme = {"name": "prefers-color-scheme", "value": "dark" if is_dark else "light"}
        self.driver.execute_cdp_cmd("Emulation.setEmulatedMedia", {"features": [scheme]})
        self.driver.get(page.resolve().as_uri())
        self.driver.execute_script("localStorage.clear()")  # the site remembers light or dark
        self.driver.refresh()

    def find_clipped(self, may_scroll: bool) -> list[str]:
        """Return what cannot be seen; ``may_scroll``: wide tables may scroll in their boxes."""
        head = f"const SIDEWAYS = {SHORT}, MAY_SCROLL = {str(may_scroll).lower()};"
        return self.driver.execute_script(head + FIND_CLIPPED)

    def contrast(self, selector: str) -> float:
        """Return the contrast of an element's text and its ground, by WCAG: 1 to 21."""
        script = """
        const luminance = text => {
          const parts = text.match(/[\\d.]+/g).slice(0, 3).map(v => v / 255)
            .map(v => v <= 0.04045 ? v / 12.92 : ((v + 0.055) / 1.055) ** 2.4);
          return 0.2126 * parts[0] + 0.7152 * parts[1] + 0.0722 * parts[2];
        };
        const element = document.querySelector(arguments[0]);
        let ground = element;
        const colour = of => getComputedStyle(of).backgroundColor;
        while (ground.parentElement && /, 0\\)$|transparent/.test(colour(ground)))
          ground = ground.parentElement;
        const [dark, light] = [getComputedStyle(element).color,
          getComputedStyle(ground).backgroundColor].map(luminance).sort((a, b) => a - b);
        return (light + 0.05) / (dark + 0.05);
        """
        return self.driver.execute_script(script, selector)
