"""Makes the pictures of the documentation: `make pictures`, or some: `make pictures PICTURES=demo`.

Each picture is a function of PICTURES. It runs the commands of a user, and a browser without a
window takes the pictures of what these write, in light and in dark. The pictures have the width of
a page on a code hosting site, at twice its pixels.
"""

import argparse
import base64
import io
import json
import math
import re
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from block_diagram import block_diagram
from chromium import browsing
from PIL import Image

ROOT = Path(__file__).parent.parent
FOLDER = ROOT / "docs" / "pictures"
WORK = ROOT / "build" / "pictures"
WIDTH = 830  # of a page on a code hosting site, in points
PIXELS_OF_A_POINT = 2
LARGEST_KB = 260
# colours of a picture, of which the largest number counts with which its file is small
COLOURS = (128, 96, 64, 48)
SCHEMES = ("light", "dark")
# what a page of a drawing looks like
DRAWING = """<!doctype html><meta charset="utf-8"><style>
:root{{color-scheme:light dark}}body,hr{{margin:0}}body{{font-family:system-ui,sans-serif}}
svg{{width:100%;height:auto;display:block}}
@media (prefers-color-scheme:dark){{body{{background:#0d1117;color:#e6edf3}}svg{{filter:brightness(1.2)}}}}
</style>{svg}<hr>"""


TOP_OF = """
const found = document.querySelector(arguments[0]);
return found.getBoundingClientRect().top + window.scrollY;
"""


def rollerrig(folder, *words):
    """Run a command in a folder, and return what it prints with `--json`."""
    command = [sys.executable, "-m", "rollerrig.realtime.cli", *words, "--json"]
    result = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)
    # 1: a verdict failed, which a picture may show; after a crash there is no output
    assert result.returncode in (0, 1), f"{' '.join(words)}:\n{result.stderr}"
    assert result.stdout, f"{' '.join(words)}:\n{result.stderr}"
    return json.loads(result.stdout)


def photograph(browser, page, name, end, begin="html", width=WIDTH):
    """Take the pictures of a part of a page, in light and in dark.

    `page`: the file. `begin`, `end`: selectors of CSS; the picture is from the top of the first
    element that `begin` selects to the top of the first one that `end` selects. `width`: of the
    window, in points.
    """
    for scheme in SCHEMES:
        feature = {"name": "prefers-color-scheme", "value": scheme}
        browser.execute_cdp_cmd("Emulation.setEmulatedMedia", {"features": [feature]})
        resize(browser, width, 1200)
        browser.get(page.as_uri())
        top = math.floor(browser.execute_script(TOP_OF, begin))
        bottom = math.floor(browser.execute_script(TOP_OF, end))
        save(screenshot(browser, width, top, bottom), f"{name}-{scheme}")


def resize(browser, width, height):
    """Give the page of a browser a size in points."""
    size = {"width": width, "height": height, "deviceScaleFactor": 0, "mobile": False}
    browser.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", size)


def screenshot(browser, width, top, bottom, pixels=PIXELS_OF_A_POINT * WIDTH):
    """Return a part of the page as an image that is so many pixels wide."""
    clip = {
        "x": 0,
        "y": top,
        "width": width,
        "height": bottom - top,
        "scale": pixels / width,
    }
    options = {"clip": clip, "captureBeyondViewport": True}
    answer = browser.execute_cdp_cmd("Page.captureScreenshot", options)
    return Image.open(io.BytesIO(base64.b64decode(answer["data"])))


def save(image, name):
    """Write an image as a small file, with fewer colours if it is large with all of them.

    Raises ValueError if it is not small.
    """
    FOLDER.mkdir(exist_ok=True)
    path = FOLDER / f"{name}.png"
    image = image.convert("RGB")
    image.save(path, optimize=True)
    for colours in COLOURS:
        if path.stat().st_size <= 1000 * LARGEST_KB:
            break
        image.quantize(colours, dither=Image.Dither.NONE).save(path, optimize=True)
    size_kb = path.stat().st_size / 1000
    print(f"{path.relative_to(ROOT)}: {image.width} x {image.height}, {size_kb:.0f} kB", flush=True)
    if size_kb > LARGEST_KB:
        raise ValueError(f"{path} has {size_kb:.0f} kB; allowed are {LARGEST_KB}")


def drawing(browser, svg, name):
    """Take the pictures of a drawing of matplotlib, whose black becomes the colour of the text."""
    text = svg.read_text(encoding="utf-8")
    text = text[text.index("<svg") :]
    text = re.sub(r"#(?:222222|000000)\b", "currentColor", text)
    text = re.sub(r"fill: ?(?:#ffffff|white)\b", "fill: none", text)
    text = text.replace("<svg ", '<svg fill="currentColor" ', 1)
    page = svg.with_suffix(".html")
    page.write_text(DRAWING.format(svg=text), encoding="utf-8")
    photograph(browser, page, name, end="hr")


def demo(browser, folder):
    """A stop on soap with the reference unit."""
    rollerrig(folder, "run", "velim_a1", "--pacing", "lockstep", "--out", "demo")
    rollerrig(folder, "view", "demo", "--png", "demo.svg", "--size", f"{WIDTH}x900")
    drawing(browser, folder / "demo.svg", "demo")


def viewer(_browser, folder):
    """The rig in 3D in the viewer, with locked wheels. The viewer is dark."""
    rollerrig(folder, "run", "leaf_film", "--wsp", "none", "--pacing", "free", "--out", "leaves")
    size = "3320x2000"  # the part with the rig is then as wide as a page
    rollerrig(folder, "view", "leaves", "--png", "whole.png", "--time", "8", "--size", size)
    save(Image.open(folder / "whole.png").crop((2508, 520, 3320, 930)), "viewer")


def report(browser, folder):
    """The report of a sequence, without its title block, the table of axles and the curves."""
    rollerrig(folder, "sequence", "emergency_120", "--out", "report")
    page = folder / "report" / "report.html"
    photograph(browser, page, "report", begin="h2", end="h2 ~ table ~ table ~ table", width=1000)


def campaign(browser, folder):
    """The page of a campaign, from its top."""
    rollerrig(folder, "campaign", "low_adhesion", "--out", "campaign")
    photograph(browser, folder / "campaign" / "report.html", "campaign", "h2:nth-of-type(2)")


def explain(browser, folder):
    """The report of an explanation, from its top."""
    rollerrig(folder, "explain", "open_rail_cleaning", "--out", "explain")
    photograph(browser, folder / "explain" / "report.html", "explain", "h2:nth-of-type(2)")


def eurosprinter(browser, folder):
    """The creep curve of a locomotive, with fits."""
    rollerrig(folder, "tune", "eurosprinter_127001", "--out", "tune")
    page = (folder / "tune" / "tune.html").read_text(encoding="utf-8")
    svg = folder / "eurosprinter.svg"
    svg.write_text(re.search(r"<svg.*?</svg>", page, re.DOTALL)[0], encoding="utf-8")
    drawing(browser, svg, "eurosprinter")


def protection(browser, folder):
    """Steady adhesion over creepage, and stopping distance over the slip band."""
    rollerrig(folder, "bench", "protection", "--png", "protection.svg")
    drawing(browser, folder / "protection.svg", "protection")


def desk(browser, _folder):
    """The desk with a stop on leaves, and its library of runs, as on a screen of 1366 x 768."""
    from desk_process import Page, served  # in tests/realtime, which the Makefile adds

    width, height = 1366, 768

    def both(name):
        for scheme in SCHEMES:
            feature = {"name": "prefers-color-scheme", "value": scheme}
            browser.execute_cdp_cmd("Emulation.setEmulatedMedia", {"features": [feature]})
            time.sleep(1.5)
            save(screenshot(browser, width, 0, height, pixels=width), f"{name}-{scheme}")

    resize(browser, width, height)
    # the page shows the name of its folder
    with tempfile.TemporaryDirectory(prefix="rig-") as folder, served(Path(folder)) as one:
        # two runs for the library
        for scenario in ("dry_stop", "leaf_film"):
            words = ("run", scenario, "--pacing", "free", "--out", f"runs/{scenario}")
            rollerrig(Path(folder), *words)
        browser.get(one.address)
        page = Page(browser)
        page.prepare("adhesion=leaf_film initial_speed_m_s=25 duration_max_s=600 stand_s=60")
        page.click("Start")
        page.shows(": running")
        time.sleep(2.0)
        page.put("brake demand, bar", "3.8")
        page.click("Set")
        time.sleep(10.0)
        page.click("Inject")
        page.shows("speed_sensor_stuck axle=1 begins")
        time.sleep(8.0)  # the message that it was injected is gone
        both("desk")
        page.end()
        page.open_tab("Runs")
        page.there("//td[.='runs/velim_a1']")
        time.sleep(8.0)
        both("desk_runs")


def diagram(_browser, _folder):
    """The block diagram of rig, buses and unit."""
    FOLDER.mkdir(exist_ok=True)
    for scheme in SCHEMES:
        path = FOLDER / f"rig-{scheme}.svg"
        path.write_text(block_diagram(dark=scheme == "dark"), encoding="utf-8")
        print(path.relative_to(ROOT))


PICTURES = {
    "demo": demo,
    "viewer": viewer,
    "report": report,
    "campaign": campaign,
    "explain": explain,
    "eurosprinter": eurosprinter,
    "protection": protection,
    "desk": desk,
    "rig": diagram,
}


def main():
    """Make the pictures that the command line names, or all."""
    parser = argparse.ArgumentParser(description=main.__doc__)
    parser.add_argument("names", nargs="*", choices=[[], *PICTURES], metavar="NAME")
    given = parser.parse_args()
    with browsing(WIDTH, 1200, ("--hide-scrollbars",)) as browser:
        for name in given.names or PICTURES:
            folder = WORK / name
            shutil.rmtree(folder, ignore_errors=True)
            folder.mkdir(parents=True)
            PICTURES[name](browser, folder)


if __name__ == "__main__":
    main()
