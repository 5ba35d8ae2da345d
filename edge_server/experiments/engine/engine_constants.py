"""Numbers of the engine that runs a function over many inputs.

None changes a result: they say how work is shared out, what is done when a part of the machinery fails, and when a
result is known.
"""

from __future__ import annotations

# --- tasks and workers (engine) ---
BATCH = 6  # inputs of one group in a task: enough to share images, few enough that Ctrl-C loses little work
# Times that a task is tried again whose worker or machine died: one that ends every worker it gets, as one that takes
# more memory than there is, is not tried for ever.
RETRIES = 3
# Between two looks of a worker at whether the process that started it is still there: a parent that is killed cannot
# end its workers. Half a second costs nothing beside tasks of seconds, and nobody waits for it.
PARENT_EVERY_S = 0.5

# --- results that are known (content_key) ---
# Folders whose code changes no result of repeated work: what is kept stays known when it changes.
ASIDE = ("edge_server/page/", "edge_server/report/", "channel_emu/live/")
