"""The desk is one view at 1366 x 768, in light and in dark, and everybody can use it.

The window has the size of the smallest screens that control rooms use. Rules of accessibility are
those of WCAG 2.2, checked by axe-core.
"""

import contextlib
import re

import pytest
from bench_process import until
from chromium import browsing
from desk_process import TABULATOR, Page, served

from rollerrig.configs.vehicle import MOST_AXLES

pytest.importorskip("nicegui", reason="the desk needs nicegui")

WIDTH, HEIGHT = 1366, 768
# a train with the most axles, all with a motor: no packaged vehicle has so many
TRAIN = "train_of_most_axles"
VEHICLES = {
    "velim_a1": 4,
    "bogie_low": 2,
    "tram_low_dynamic": 6,
    "tram_emergency_magnetic": 6,
    "multiple_unit_low_dynamic": 8,
    TRAIN: MOST_AXLES,
}
# what an operator has to see without scrolling, as selectors of CSS
IN_VIEW = {
    "emergency stop": ".desk-head button",
    "state of each part": ".desk-light",
    "speed, slip, demand as figures": ".desk-figure b",
    "wheels": "[id^=desk-wheel-]",
    "speed, slip, adhesion, pressure as plots": ".desk-plot canvas",
    "valves": "#desk-valves",
    "prepare, start, stop, set": ".desk-controls button",
    "scenario, set-points, friction": ".desk-controls input",
    "friction in force": ".desk-frictions .desk-small",
    "faults": ".desk-side input, .desk-side button",
    "active faults": ".desk-active-list",
    "alarms": ".desk-alarms",
}
# for each selector: how many elements there are, and which are not whole inside the window
OUTSIDE = """
return arguments[0].map((selector) => {
  const found = [...document.querySelectorAll(selector)];
  const outside = found.filter((one) => {
    const box = one.getBoundingClientRect();
    const inside = box.top >= 0 && box.left >= 0 && box.bottom <= window.innerHeight + 0.5
      && box.right <= window.innerWidth + 0.5;
    return !inside || box.width === 0 || box.height === 0;
  });
  return [found.length, outside.map((one) => one.outerHTML.slice(0, 90))];
});
"""
# what scrolls, up or sideways
SCROLLS = """
const places = [document.documentElement, ...document.querySelectorAll(
  ".desk-page, .desk-panels, .desk-panels .q-panel, .desk-controls, .desk-live, .desk-side, .desk-plots")];
return places.filter((one) => one.scrollHeight > one.clientHeight + 1 || one.scrollWidth > one.clientWidth + 1)
  .map((one) => one.className);
"""
LIGHTNESS = """
const [red, green, blue] = getComputedStyle(document.body).backgroundColor.match(/[\\d.]+/g).map(Number);
return (red + green + blue) / 3 / 255;
"""
CALM = "return !document.getAnimations().some((one) => one instanceof CSSTransition);"
TITLE_COLOUR = """
const { id } = desk.settings.plots[0];
return [getElement(id).chart.getOption().title[0].textStyle.color, desk.ink.text];
"""


@contextlib.contextmanager
def opened(folder, scenario="velim_a1", scheme="light"):
    """Yield a browser with the page of a desk that offers a scenario first."""
    if scenario == TRAIN:
        scenario = train(folder)
    with served(folder, "--scenario", scenario) as desk, browsing() as browser:
        size = {"width": WIDTH, "height": HEIGHT, "deviceScaleFactor": 1, "mobile": False}
        browser.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", size)
        follow(browser, scheme)
        browser.get(desk.address)
        Page(browser).shows("This page has no safety function")
        until(lambda: browser.execute_script("return Boolean(window.desk?.settings)"), "settings")
        until(lambda: browser.find_elements("css selector", "[id^=desk-wheel-]"), "wheels")
        yield browser


def follow(browser, scheme):
    """Let the system of a browser be light or dark."""
    feature = {"name": "prefers-color-scheme", "value": scheme}
    browser.execute_cdp_cmd("Emulation.setEmulatedMedia", {"features": [feature]})


def train(folder):
    """Write a scenario with a vehicle of the most axles, and return its path."""
    from rollerrig.configs import store

    text = store.find("vehicles", "multiple_unit_2_cars").read_text(encoding="utf-8")
    text = re.sub(r"(?m)^axles = 8$", f"axles = {MOST_AXLES}", text)
    (folder / "train.toml").write_text(text, encoding="utf-8")
    (folder / f"{TRAIN}.toml").write_text('vehicle = "train.toml"\n', encoding="utf-8")
    return str(folder / f"{TRAIN}.toml")


@pytest.mark.parametrize(
    "scenario",
    [
        scenario if scenario == "velim_a1" else pytest.param(scenario, marks=pytest.mark.nightly)
        for scenario in VEHICLES
    ],
)
def test_an_operator_sees_everything_in_one_view(tmp_path, scenario):
    axles = VEHICLES[scenario]
    with opened(tmp_path, scenario) as browser:
        until(lambda: browser.find_elements("css selector", ".desk-plot canvas"), "plots")
        counts = {}
        answers = browser.execute_script(OUTSIDE, list(IN_VIEW.values()))
        for what, (count, outside) in zip(IN_VIEW, answers, strict=True):
            assert count, what
            assert outside == [], what
            counts[what] = count
        assert counts["wheels"] == counts["friction in force"] == axles
        assert counts["speed, slip, adhesion, pressure as plots"] >= 4
        assert browser.execute_script(SCROLLS) == []
        least_px = browser.execute_script(
            "return Math.min(...[...document.querySelectorAll('.desk-plot')].map((one) => one.clientHeight));"
        )
        assert least_px >= 120


def test_the_page_follows_the_system_and_so_does_the_text_of_its_plots(tmp_path):
    with opened(tmp_path) as browser:
        for scheme, is_light in (("light", True), ("dark", False), ("light", True)):
            follow(browser, scheme)

            def follows(is_light=is_light):
                title, text = browser.execute_script(TITLE_COLOUR)
                lightness = browser.execute_script(LIGHTNESS)
                return (
                    title == text
                    and (lightness > 0.9) == is_light
                    and (lightness < 0.2) != is_light
                )

            until(follows, scheme)


def test_a_start_that_has_no_effect_looks_like_it(tmp_path):
    look = """
    const button = [...document.querySelectorAll("button")].find((one) => one.textContent.trim() === arguments[0]);
    const style = getComputedStyle(button);
    return [button.disabled, style.backgroundColor, style.outlineStyle];
    """
    with opened(tmp_path) as browser:
        until(lambda: browser.execute_script(look, "Start")[0], "a START that is disabled")
        disabled, colour, outline = browser.execute_script(look, "Start")
        assert disabled
        assert outline == "dashed"
        _, colour_of_prepare, _ = browser.execute_script(look, "Prepare")
        red, green, blue = map(int, re.findall(r"\d+", colour)[:3])
        assert max(red, green, blue) - min(red, green, blue) < 12, "a disabled button is grey"
        assert colour != colour_of_prepare


def test_the_scale_of_adhesion_is_that_of_what_is_used_and_limits_are_named(tmp_path):
    scale = """
    const used = { limit: false, data: [[0, 0.04], [1, 0.071]] };
    const limit = { limit: true, data: [[0, 0.36], [1, 0.36]] };
    return verticalRange([limit, used], 0.05);
    """
    with opened(tmp_path) as browser:
        assert browser.execute_script(scale) == {"min": 0, "max": pytest.approx(0.08)}
        names = browser.execute_script(
            "return desk.settings.plots.flatMap((plot) => getElement(plot.id).chart.getOption().series"
            ".filter((_, at) => plot.lines[at].limit).map((one) => one.name));"
        )
        assert set(names) == {"limit f_d as found", "limit f_r cleaned"}


def test_every_control_is_reached_by_the_keyboard(tmp_path):
    controls = """
    const found = [...document.querySelectorAll("button, input, [role=tab][tabindex='0']")];
    const usable = found.filter((one) => !one.disabled && one.tabIndex >= 0 && one.getClientRects().length);
    usable.forEach((one, at) => one.dataset.control = at);
    return usable.length;
    """
    with opened(tmp_path) as browser:
        until(lambda: browser.find_elements("xpath", "//button[@disabled]"), "a page at rest")
        count = browser.execute_script(controls)
        assert count > 25
        seen = set()
        for _ in range(2 * count):
            browser.switch_to.active_element.send_keys(TABULATOR)
            seen.add(
                browser.execute_script("return document.activeElement.dataset.control ?? null")
            )
        missed = [
            browser.find_element("css selector", f"[data-control='{at}']").get_attribute(
                "outerHTML"
            )
            for at in range(count)
            if str(at) not in seen
        ]
        assert missed == []


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_no_page_has_a_serious_finding_of_axe(tmp_path, scheme, stop_on_leaves):
    axe = pytest.importorskip("axe_core_python", reason="axe-core-python is not installed")
    from pathlib import Path

    rules = (Path(axe.__file__).parent / "axe.min.js").read_text(encoding="utf-8")
    find = """
    const answer = arguments[0];
    axe.run().then((result) => answer(result.violations
      .filter((one) => ["serious", "critical"].includes(one.impact) || one.id === "page-has-heading-one")
      .map((one) => `${one.id}: ${one.nodes.map((node) => node.html.slice(0, 120)).join(", ")}`)));
    """
    (tmp_path / "runs").mkdir()
    (tmp_path / "runs" / "leaves").symlink_to(stop_on_leaves.out)
    with opened(tmp_path, scheme=scheme) as browser:
        browser.execute_script(rules)
        assert browser.execute_script("return document.documentElement.lang").startswith("en")
        for tab, there in (
            ("Manual", ".desk-plot canvas"),
            ("Automatic", ".q-textarea"),
            ("Runs", ".desk-runs td"),
        ):
            Page(browser).open_tab(tab)
            until(lambda: browser.find_elements("css selector", there), tab)  # noqa: B023
            # a colour that is still changing has no contrast yet
            until(lambda: browser.execute_script(CALM), tab)
            assert browser.execute_async_script(find) == [], tab
