"""A headless Chromium with a phone's screen as well, whose consoles are read."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

from tests.validation.browser import TIMEOUT_MS

if TYPE_CHECKING:
    from playwright.sync_api import Browser, ConsoleMessage, Page


class Chromium:
    """A headless Chromium: ``page`` is its first page, :meth:`phone` opens others.

    Whatever its pages write to their consoles as errors is kept for :meth:`take_errors`.
    """

    def __init__(self, browser: Browser) -> None:
        self._browser = browser
        self._errors: list[str] = []
        self.page = self._watched(browser.new_page(viewport={"width": 1280, "height": 800}))

    @contextmanager
    def phone(self, width: int = 390, height: int = 844) -> Iterator[Page]:
        """A page on a touch screen of so many CSS pixels, two device pixels each."""
        page = self._browser.new_page(
            viewport={"width": width, "height": height},
            is_mobile=True,
            has_touch=True,
            device_scale_factor=2,
        )
        try:
            yield self._watched(page)
        finally:
            page.close()

    def take_errors(self) -> list[str]:
        """The errors in the consoles since the last call: exceptions, refusals, failed loads."""
        for context in self._browser.contexts:
            for page in context.pages:
                page.evaluate("1")  # events come in order: earlier ones are here with its answer
        taken, self._errors = self._errors, []
        return taken

    def _watched(self, page: Page) -> Page:
        def note(message: ConsoleMessage) -> None:
            if message.type in ("error", "assert"):
                self._errors.append(f"{message.text} {message.location['url']}".rstrip())

        page.on("console", note)
        page.on("pageerror", lambda error: self._errors.append(f"{error.name}: {error.message}"))
        page.set_default_timeout(TIMEOUT_MS)
        return page
