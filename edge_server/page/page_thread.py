"""A thread of the page: it ends when told to, and its errors are logged without ending it or the server."""

from __future__ import annotations

import logging
import threading

log = logging.getLogger(__name__)


class PageThread:
    """Base of the page's threads; a subclass implements ``_run``, which returns once ``_stopped``.

    name: of the thread. what: names its work in log lines.
    """

    def __init__(self, name: str, what: str) -> None:
        self._what, self._last_error = what, ""
        self._wake = threading.Condition()
        self._stopped = False
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)

    def start(self) -> None:
        self._thread.start()

    def stop(self) -> None:
        """End the thread. May be called twice, and before ``start``."""
        with self._wake:
            self._stopped = True
            self._wake.notify_all()
        if self._thread.is_alive():
            self._thread.join(timeout=5.0)

    def _run(self) -> None:
        raise NotImplementedError

    def _pause(self, seconds: float) -> None:
        """Wait so long, or until the end."""
        with self._wake:
            self._wake.wait_for(lambda: self._stopped, seconds)

    def _say(self, error: Exception) -> None:
        """Log an error, but not again until another one came."""
        text = f"{type(error).__name__}: {error}"
        if text != self._last_error:
            self._last_error = text
            log.warning("page: %s failed: %s", self._what, text, exc_info=error)
