"""A thread of the page: it repeats a step until stopped; errors are logged and end neither it nor the server."""

from __future__ import annotations

import logging
import threading

from edge_server.page import page_constants as tuned

log = logging.getLogger(__name__)


class PageThread:
    """Base of the page's threads; a subclass implements ``_step``, which returns the seconds until the next one.

    name: of the thread. what: names its work in log lines. ``wake`` begins the next step at once.
    """

    def __init__(self, name: str, what: str) -> None:
        self._what, self._last_error = what, ""
        self._wake = threading.Condition()
        self._stopped = self._asked = False
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)

    def start(self) -> None:
        self._thread.start()

    def stop(self) -> None:
        """End the thread. May be called twice, and before ``start``."""
        with self._wake:
            self._stopped = True
            self._wake.notify_all()
        if self._thread.is_alive():
            self._thread.join(timeout=tuned.THREAD_END_S)

    def wake(self) -> None:
        """Begin the next step at once, or right after the current one."""
        with self._wake:
            self._asked = True
            self._wake.notify_all()

    def _step(self) -> float:
        raise NotImplementedError

    def _run(self) -> None:
        while not self._stopped:
            try:
                seconds = self._step()
            except Exception as error:  # the page must never stop the server
                self._say(error)
                with self._wake:
                    self._wake.wait_for(lambda: self._stopped, tuned.AFTER_ERROR_S)
                continue
            with self._wake:
                self._wake.wait_for(lambda: self._stopped or self._asked, max(seconds, 0.0))
                self._asked = False

    def _say(self, error: Exception) -> None:
        """Log an error, but do not repeat it until a different one occurred."""
        text = f"{type(error).__name__}: {error}"
        if text != self._last_error:
            self._last_error = text
            log.warning("page: %s failed: %s", self._what, text, exc_info=error)
