"""The report in a real browser without a network: what is drawn, what it answers, what it asks for."""

import io
import json
import os
import shutil
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

webdriver = pytest.importorskip("selenium.webdriver", reason="selenium is not installed; run `make setup`")
from selenium.webdriver.chrome.options import Options  # noqa: E402
from selenium.webdriver.chrome.service import Service  # noqa: E402
from selenium.webdriver.support.ui import Select  # noqa: E402

CHROME = next((path for name in ("chromium", "google-chrome", "chrome") if (path := shutil.which(name))), None)
DRIVER = shutil.which("chromedriver")
pytestmark = pytest.mark.skipif(
    CHROME is None or DRIVER is None,
    reason="no chromium or google-chrome with its chromedriver on PATH; install chromium and chromium-driver",
)
OPTIONS = (
    "--headless=new",
    "--use-gl=angle",  # WebGL 2 on a processor
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--host-resolver-rules=MAP * ~NOTFOUND",  # no network, whatever a page asks for
    "--disable-quic",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
    "--disable-dev-shm-usage",
    "--force-device-scale-factor=1",
    "--window-size=1280,1000",
)
PATIENCE_S = 60.0
Pixels = np.ndarray[Any, np.dtype[np.uint8]]


@pytest.fixture(scope="module")
def browser(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Any]:
    options = Options()
    options.binary_location = str(CHROME)
    root = ("--no-sandbox",) if os.geteuid() == 0 else ()
    for option in (*OPTIONS, *root, f"--user-data-dir={tmp_path_factory.mktemp('browser')}"):
        options.add_argument(option)
    options.set_capability("goog:loggingPrefs", {"browser": "ALL", "performance": "ALL"})
    driver = webdriver.Chrome(options=options, service=Service(DRIVER))
    driver.get("about:blank")
    for kind in ("browser", "performance"):  # of the browser's own first page
        driver.get_log(kind)
    yield driver
    driver.quit()


def until(done: Callable[[], bool], what: str) -> None:
    end = time.monotonic() + PATIENCE_S
    while not done():
        assert time.monotonic() < end, f"no {what} within {PATIENCE_S:g} s"
        time.sleep(0.05)


class View:
    """The 3-D view of an open report."""

    def __init__(self, browser: Any) -> None:
        self.browser, self.box = browser, browser.find_element("id", "viewer")
        browser.execute_script("arguments[0].scrollIntoView()", self.box)

    def wait(self, shown: str) -> Pixels:
        """The picture of what is shown, when it is that."""

        def ready() -> bool:
            return (self.box.get_attribute("data-state"), self.box.get_attribute("data-shown")) == ("ready", shown)

        until(ready, f"view of {shown}, but {self.box.get_attribute('data-state')}")
        return self.picture()

    def picture(self) -> Pixels:
        # A frame is on the screen after the one that follows its drawing.
        self.browser.execute_async_script("requestAnimationFrame(() => requestAnimationFrame(arguments[0]))")
        canvas = self.browser.find_element("id", "v-canvas")
        return np.array(Image.open(io.BytesIO(canvas.screenshot_as_png)).convert("RGB"))

    def choose(self, name: str, value: str) -> None:
        Select(self.browser.find_element("id", f"v-{name}")).select_by_value(value)

    def tick(self, layer: str) -> None:
        self.browser.execute_script(f"document.getElementById('l-{layer}').click()")


def colours(picture: Pixels) -> int:
    return len(np.unique(picture.reshape(-1, 3), axis=0))


def share_changed(one: Pixels, other: Pixels) -> float:
    assert one.shape == other.shape
    return float((np.abs(one.astype(int) - other.astype(int)).max(axis=2) > 20).mean())


def test_the_report_in_a_browser(browser: Any, report: Path) -> None:
    browser.get((report / "index.html").as_uri())
    view = View(browser)
    graph = view.wait("phantom/ct1/patient/skeleton_graph/true")
    assert colours(graph) > 500, "expected a picture, got a blank canvas"
    told = browser.find_element("id", "v-told").text
    assert "ct1 to patient, Skeleton graph: Hausdorff distance" in told
    assert "nothing here was measured" in browser.find_element("id", "v-kind").text
    # Each choice and each layer draws something else.
    view.choose("method", "truth")
    assert share_changed(view.wait("phantom/ct1/patient/truth/true"), graph) > 0.02
    assert browser.find_element("id", "v-told").text != told
    view.choose("pair", "1")
    second = view.wait("phantom/ct2/patient/truth/true")
    view.choose("method", "skeleton_graph")
    assert share_changed(view.wait("phantom/ct2/patient/skeleton_graph/true"), graph) > 0.02
    view.choose("colour", "part")
    parts = view.wait("phantom/ct2/patient/skeleton_graph/part")
    assert share_changed(parts, second) > 0.02
    for layer, least in (
        ("warped", 0.01),
        ("slices", 0.05),
        ("us", 0.001),
        ("path", 0.001),
        ("graph", 0.001),
        ("source", 0.01),
    ):
        before = view.picture()
        view.tick(layer)
        assert share_changed(view.picture(), before) > least, layer
    before = view.picture()
    browser.find_element("css selector", "[data-look='270,5']").click()
    assert share_changed(view.picture(), before) > 0.02, "a button turns the view"
    before = view.picture()
    browser.find_element("id", "v-canvas").send_keys("\ue014\ue014\ue014")  # arrow right
    assert share_changed(view.picture(), before) > 0.01, "arrow keys turn the view"
    assert_quiet(browser)


def test_colours_rise_in_lightness_and_differ_to_colour_blind_readers(browser: Any, report: Path) -> None:
    browser.get((report / "index.html").as_uri())
    View(browser).wait("phantom/ct1/patient/skeleton_graph/true")
    bar = browser.find_element("id", "v-ramp").screenshot_as_png
    pixels = np.array(Image.open(io.BytesIO(bar)).convert("RGB"))
    line = pixels[len(pixels) // 2, 3:-3].astype(float)
    lightness = line @ [0.2126, 0.7152, 0.0722]
    assert (np.diff(lightness[:: len(lightness) // 12]) > 5).all()
    # Viénot, Brettel and Mollon 1999: what a reader without red or green cones sees, in linear light.
    linear = (line / 255) ** 2.2
    for matrix in (
        [[0.11238, 0.88762, 0], [0.11238, 0.88762, 0], [0.00401, -0.00401, 1]],
        [[0.29275, 0.70725, 0], [0.29275, 0.70725, 0], [-0.02234, 0.02234, 1]],
    ):
        seen = 255 * np.clip(linear @ np.array(matrix).T, 0, 1) ** (1 / 2.2)
        steps = seen[:: len(seen) // 8]
        apart = np.linalg.norm(steps[:, None] - steps[None], axis=2) + 1e3 * np.eye(len(steps))
        assert apart.min() > 15


def test_every_page_fits_a_phone_and_is_quiet(browser: Any, report: Path) -> None:
    size = {"width": 360, "height": 740, "deviceScaleFactor": 1, "mobile": True}
    browser.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", size)
    try:
        for page in sorted(report.rglob("*.html")):
            browser.get(page.as_uri())
            if page.name == "index.html":
                assert colours(View(browser).wait("phantom/ct1/patient/skeleton_graph/true")) > 500
            widths = browser.execute_script("return [document.documentElement.scrollWidth, innerWidth]")
            assert widths == [360, 360], page.name
            small = browser.execute_script(
                "return [...document.querySelectorAll('p, li, td, label')]"
                ".filter((e) => e.innerText.trim() && parseFloat(getComputedStyle(e).fontSize) < 12).length"
            )
            assert small == 0, f"{page.name}: text too small to read"
            unlabelled = browser.execute_script(
                "return [...document.querySelectorAll('select, input')].filter((e) => !e.labels.length).length"
            )
            assert unlabelled == 0
            undescribed = browser.execute_script(
                "return [...document.images].filter((e) => !e.alt.trim() || (e.complete && !e.naturalWidth)).length"
            )
            assert undescribed == 0, f"{page.name}: an image without words or that is not there"
            assert_quiet(browser)
    finally:
        browser.execute_cdp_cmd("Emulation.clearDeviceMetricsOverride", {})


def test_a_pair_whose_file_is_gone_is_told(browser: Any, report: Path, tmp_path: Path) -> None:
    shutil.copytree(report, tmp_path / "report")
    (tmp_path / "report" / "data" / "phantom--ct1--patient.js").unlink()
    browser.get((tmp_path / "report" / "index.html").as_uri())
    view = View(browser)
    until(lambda: view.box.get_attribute("data-state") == "failed", "word of the file")
    assert "is not in the report's folder" in browser.find_element("id", "v-told").text
    for kind in ("browser", "performance"):  # the missing file is an error of this page alone
        browser.get_log(kind)


def assert_quiet(browser: Any) -> None:
    """No word in the console, no request but for files of the report."""
    said = [entry["message"] for entry in browser.get_log("browser") if entry["level"] in ("SEVERE", "WARNING")]
    assert not said, said
    events = [json.loads(entry["message"])["message"] for entry in browser.get_log("performance")]
    asked = [e["params"]["request"]["url"] for e in events if e["method"] == "Network.requestWillBeSent"]
    assert any(url.endswith(".html") for url in asked), "expected requests to look at, got none"
    assert not [url for url in asked if not url.startswith(("file:", "data:", "blob:"))]
