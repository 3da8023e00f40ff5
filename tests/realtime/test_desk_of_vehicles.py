"""The desk shows every axle, the motors and the magnets of a tram in a browser.

Each state that a test waits for lasts until the test changes it: without running resistance, and
with so small a brake demand, the tram rolls longer than a test waits. So no test depends on how
often the browser draws.
"""

import contextlib

import pytest
from bench_process import until
from chromium import browsing
from desk_process import Page, served

pytest.importorskip("nicegui", reason="the desk needs nicegui")

AXLES = range(1, 7)
DRIVEN = (1, 2, 5, 6)
BOGIES = ["desk-magnet-1", "desk-magnet-3", "desk-magnet-5"]
GENTLE = (
    "adhesion=dry vehicle.resistance_A_N=0 vehicle.resistance_C_N_s2_m2=0 "
    "duration_max_s=600 stand_s=60"
)
GENTLE_DEMAND_BAR = "0.45"  # 0.15 bar above the spring of the brake cylinders


@contextlib.contextmanager
def rolling(tmp_path, scenario, values=""):
    """Yield the page of a desk whose bench runs a scenario, without a brake demand."""
    with served(tmp_path, "--scenario", scenario) as one, browsing() as browser:
        browser.get(one.address)
        desk_page = Page(browser)
        desk_page.shows("This page has no safety function")
        desk_page.prepare(f"{GENTLE} {values}")
        desk_page.shows("set to 0.00 bar over Modbus")
        desk_page.click("Start")
        desk_page.shows(": running")
        yield desk_page
        desk_page.end()


def demand(desk_page, pressure_bar):
    """Set a brake demand, and wait until the page shows it.

    Before that, the page may still replace the next value in the field by this one.
    """
    desk_page.put("brake demand, bar", pressure_bar)
    desk_page.click("Set")
    desk_page.shows(f"set to {pressure_bar} bar over Modbus")


def inject(desk_page, fault):
    """Choose a fault of the catalogue and inject it with its default values."""
    field = desk_page.there("//input[@aria-label='fault']")
    desk_page.browser.execute_script("arguments[0].scrollIntoView()", field)
    field.click()
    field.send_keys(fault)
    desk_page.there(f"//div[@role='option'][contains(., '{fault}:')]").click()
    desk_page.click("Inject")


def texts_of_motors(desk_page):
    """Return the text below each axle."""
    texts = desk_page.browser.execute_script(
        "return [...document.querySelectorAll('[id^=desk-motor-]')].map((one) => one.textContent);"
    )
    return dict(zip(AXLES, texts, strict=True))


def magnets_on_the_rail(desk_page):
    return desk_page.browser.execute_script(
        "return [...document.querySelectorAll('.desk-on-rail')].map((one) => one.id);"
    )


def check_axles(desk_page, titles):
    """Check that each axle has a wheel and a lane, and that the plots have points of each axle."""
    script = desk_page.browser.execute_script
    assert script("return document.querySelectorAll('[id^=desk-wheel-]').length;") == len(AXLES)
    plots = script(
        """return desk.settings.plots.map((plot) => {
          const { title, series } = getElement(plot.id).chart.getOption();
          return [title[0].text, series.filter((one) => one.data.length).length];
        });"""
    )
    for title in titles:
        (lines,) = (lines for text, lines in plots if title in text)
        assert lines >= len(AXLES)
    columns = script("return desk.settings.columns;")
    for axle in AXLES:
        assert f"valve_{axle}" in columns


@pytest.mark.nightly
def test_the_desk_shows_the_torque_of_each_motor_and_that_it_is_released(tmp_path):
    with rolling(tmp_path, "tram_low_dynamic") as desk_page:
        assert not any(texts_of_motors(desk_page).values())

        demand(desk_page, GENTLE_DEMAND_BAR)

        def braking():
            texts = texts_of_motors(desk_page)
            return all(texts[axle].endswith(" kN m") for axle in DRIVEN)

        until(braking, "a torque below each axle with a motor")

        # the rig releases the motors as long as the units are lost
        inject(desk_page, "wsp_frozen")

        def released():
            texts = texts_of_motors(desk_page)
            return all(texts[axle] == "motor released" for axle in DRIVEN)

        until(released, "released motors")
        # the middle bogie has no motors
        texts = texts_of_motors(desk_page)
        assert texts[3] == texts[4] == ""
        check_axles(
            desk_page, ("Motors: braking torque", "Motors: share", "Brake cylinder pressures")
        )
        desk_page.shows("nodes 16, 48, 17, 49 operational")


@pytest.mark.nightly
def test_the_desk_shows_the_magnets_of_each_bogie_on_the_rail(tmp_path):
    # weak magnets, which act at the gentle demand
    magnets = (
        "magnetic_track_brake.emergency_pressure_Pa=4e4 magnetic_track_brake.attraction_N=1000"
    )
    with rolling(tmp_path, "tram_emergency_magnetic", magnets) as desk_page:
        assert magnets_on_the_rail(desk_page) == []
        demand(desk_page, GENTLE_DEMAND_BAR)
        until(lambda: magnets_on_the_rail(desk_page) == BOGIES, "all magnets on the rail")
        check_axles(desk_page, ("Magnets: force",))
        demand(desk_page, "0.00")
        until(lambda: magnets_on_the_rail(desk_page) == [], "all magnets raised")


def wheels(desk_page):
    return desk_page.browser.execute_script(
        "return document.querySelectorAll('[id^=desk-wheel-]').length;"
    )


@pytest.mark.nightly
def test_one_desk_runs_a_bogie_and_then_a_coach(tmp_path):
    with served(tmp_path) as one, browsing() as browser:
        browser.get(one.address)
        desk_page = Page(browser)
        until(lambda: wheels(desk_page) == 4, "the coach")
        for vehicle, axles in (("bogie_module", 2), ("uic_z1", 4)):
            desk_page.prepare(f"{GENTLE} vehicle={vehicle}")
            desk_page.click("Start")
            desk_page.shows(": running")
            until(lambda: wheels(desk_page) == axles, vehicle)  # noqa: B023
            until(lambda: browser.execute_script("return desk.rows.length;"), "rows")
            columns = browser.execute_script("return desk.settings.columns;")
            assert f"valve_{axles}" in columns
            assert f"valve_{axles + 1}" not in columns
            desk_page.end()
