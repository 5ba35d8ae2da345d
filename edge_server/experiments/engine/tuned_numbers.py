"""Numbers of the engine that runs a function over many inputs.

None changes a result: they say how work is shared out, what is done when a part of the machinery fails, and when a
result is known.
"""

from __future__ import annotations

BATCH = 6
"""Inputs of one group in a task: enough to share images, few enough that Ctrl-C loses little work."""

RETRIES = 3
"""Of a task whose worker or machine died. A task that ends every worker it gets, as one that takes more memory than
there is, is not tried for ever."""

PARENT_EVERY_S = 0.5
"""Between two looks of a worker at whether the process that started it is still there.

A parent that is killed cannot end its workers. Half a second costs nothing beside tasks of seconds, and nobody waits
for it.
"""

ASIDE = ("edge_server/page/", "edge_server/report/", "channel_emu/live/")
"""Folders whose code changes no result of repeated work: what is kept stays known when it changes."""
