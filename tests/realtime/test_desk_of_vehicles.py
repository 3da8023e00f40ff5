"""The desk shows every axle, the motors and the magnets of a tram while it brakes, in a browser."""

import pytest
from bench_process import until
from chromium import browsing
from desk_process import FREE_PORTS, Page, served

pytest.importorskip("nicegui", reason="the desk needs nicegui")

AXLES = range(1, 7)
DRIVEN = (1, 2, 5, 6)
# notes every text below an axle, and every bogie whose magnets have been drawn on the rail
OBSERVE = """
window.seenTexts = new Set();
window.seenOnRail = new Set();
const note = () => {
  for (const place of document.querySelectorAll("[id^=desk-motor-]"))
    window.seenTexts.add(`${place.id}: ${place.textContent}`);
  for (const magnet of document.querySelectorAll(".desk-on-rail")) window.seenOnRail.add(magnet.id);
};
new MutationObserver(note).observe(document.getElementById("desk-rig"), {
  subtree: true, childList: true, characterData: true, attributes: true, attributeFilter: ["class"],
});
"""


def brake(browser, address, values):
    """Open the page of a desk, prepare its bench, and start it; the scenario brakes."""
    browser.get(address)
    desk_page = Page(browser)
    desk_page.shows("This page has no safety function")
    desk_page.put("further values, as in adhesion.mu_cd=0.05", f"{FREE_PORTS} {values}")
    desk_page.click("Prepare")
    desk_page.shows(": held")
    browser.execute_script(OBSERVE)
    desk_page.click("Start")
    desk_page.shows(": running")
    return desk_page


def noted(browser, name):
    return browser.execute_script(f"return [...window.{name}];")


def check_axles(browser, titles):
    """Check that each axle has a wheel and a lane, and that the plots are there."""
    wheels = browser.execute_script("return document.querySelectorAll('[id^=desk-wheel-]').length;")
    assert wheels == len(AXLES)
    for title in titles:
        plots = browser.execute_script(
            "return desk.settings.plots.map((plot) =>"
            " getElement(plot.id).chart.getOption().title[0].text);"
        )
        assert any(title in plot for plot in plots), plots
    columns = browser.execute_script("return desk.settings.columns;")
    for axle in AXLES:
        assert f"cylinder_pressure_{axle}_Pa" in columns


def test_the_desk_shows_the_torque_of_each_motor_and_that_it_is_released(tmp_path):
    with served(tmp_path, "--scenario", "tram_low_dynamic") as one, browsing() as browser:
        # on this friction the motors slide for most of the stop
        desk_page = brake(browser, one.address, "adhesion=leaf_film stand_s=60")
        for axle in DRIVEN:
            until(
                lambda place=f"desk-motor-{axle}: ": any(
                    text.startswith(place) and text.endswith("kN m")
                    for text in noted(browser, "seenTexts")
                ),
                f"a torque below axle {axle}",
            )
        until(
            lambda: any("motor released" in text for text in noted(browser, "seenTexts")),
            "a released motor",
        )
        # the middle bogie has no motors
        assert "desk-motor-3: " in noted(browser, "seenTexts")
        assert not any(
            text.startswith("desk-motor-3: motor") for text in noted(browser, "seenTexts")
        )
        check_axles(browser, ("Motors: torque", "Motors: share"))
        desk_page.shows("nodes 16, 48, 17, 49 operational")
        desk_page.end()


def test_the_desk_shows_the_magnets_of_each_bogie_on_the_rail(tmp_path):
    with served(tmp_path, "--scenario", "tram_emergency_magnetic") as one, browsing() as browser:
        desk_page = brake(browser, one.address, "stand_s=60")
        bogies = {"desk-magnet-1", "desk-magnet-3", "desk-magnet-5"}
        until(lambda: set(noted(browser, "seenOnRail")) == bogies, "magnets on the rail")
        check_axles(browser, ("Magnets: force",))
        desk_page.end()
