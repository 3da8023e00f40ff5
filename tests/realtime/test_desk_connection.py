"""The page of a desk that does not answer: it says so, sends nothing, and sends nothing later.

The desk is stopped as a whole (SIGSTOP): its connections stay open and take what is sent, as those
of a machine that hangs do.
"""

import contextlib
import signal

import pytest
from bench_process import until
from chromium import browsing
from desk_process import Page, served

pytest.importorskip("nicegui", reason="the desk needs nicegui")

NOT_SENT = "THE EMERGENCY STOP WAS NOT SENT"
# what the desk answers to an emergency stop without a bench
ANSWER = "no bench"


@pytest.fixture(scope="module")
def opened(tmp_path_factory):
    """A desk and its page in a browser."""
    folder = tmp_path_factory.mktemp("desk")
    with served(folder) as desk, browsing() as browser:
        browser.get(desk.address)
        page = Page(browser)
        page.shows("This page has no safety function")
        until(lambda: guarded(browser), "the guarded socket")
        yield desk, page


@contextlib.contextmanager
def hanging(desk):
    """Let the desk hang for a while."""
    desk.process.send_signal(signal.SIGSTOP)
    try:
        yield
    finally:
        desk.process.send_signal(signal.SIGCONT)


def guarded(browser):
    """Return whether the page asks before it sends."""
    return browser.execute_script("return deskConnection.guarded !== null")


def notifications(page):
    """Return the messages of the desk; equal ones are one with a number."""
    return page.browser.execute_script(
        "return [...document.querySelectorAll('.q-notification')].map((one) => one.textContent);"
    )


def test_the_page_is_grey_after_a_stated_time_and_names_its_last_sample(opened):
    desk, page = opened
    assert not page.is_silent()
    with hanging(desk):
        until(lambda: page.is_silent(), "a grey page")
        page.shows("The desk has not answered since")
        line = page.browser.execute_script(
            "return document.getElementById('desk-silence').textContent"
        )
        assert "Last sample: none" in line
        assert "use the rig's own emergency stop" in line
        # the limit, and a look at the clock every quarter of a second, are below three seconds
        limits = page.browser.execute_script("return SILENCE_MS + 2 * LOOK_PAUSE_MS")
        assert limits <= 3000
    until(lambda: not page.is_silent(), "a page that is not grey")
    assert not page.browser.find_elements("id", "desk-silence")


def test_what_is_pressed_meanwhile_fails_visibly_and_is_not_sent_later(opened):
    desk, page = opened
    with hanging(desk):
        until(lambda: page.is_silent(), "a grey page")
        page.click("Prepare", answering=False)
        page.shows('NOT SENT: "Prepare"')
        page.click("Emergency stop", answering=False)
        page.shows(NOT_SENT)
        # it stays in view whatever is pressed next
        page.click("Prepare", answering=False)
    until(lambda: not page.is_silent(), "a page that is not grey")
    page.shows(NOT_SENT)
    page.click("Close")
    assert not page.browser.find_elements("id", "desk-not-sent")

    # a press that is sent is answered: what was not sent has no answer before it
    assert not notifications(page)
    page.click("Emergency stop")
    until(lambda: notifications(page), "an answer")
    (message,) = notifications(page)
    assert ANSWER in message
    assert not page.browser.find_elements("css selector", ".q-notification__badge")
    assert not page.browser.find_elements("id", "desk-not-sent")


def test_a_press_that_a_desk_receives_while_it_begins_to_hang_is_not_sent_either(opened):
    """The page does not know yet that the desk hangs: it asks before it sends."""
    desk, page = opened
    with hanging(desk):
        page.click("Emergency stop", answering=False)
        page.shows(NOT_SENT)
    until(lambda: not page.is_silent(), "a page that is not grey")
    page.click("Close")
