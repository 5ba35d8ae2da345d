"""Times, ages and sizes of the live page."""

from __future__ import annotations

FRESH_MS = 50.0
"""Up to this age a frame has the freshest color."""
STALE_MS = 2000.0
"""From this age it has the color of what is stale."""
REFRESH_S = 0.5
"""Between two refreshes of panels and scene."""
WINDOW_S = 120.0
"""Shown by the charts."""
AGE_PARTS_OF = 50
"""Publications over which the parts of the age are averaged."""
NOTICE_S = 8.0
"""For which an answer to a control stays."""
SAY_EVERY_S = 60.0
"""Between two log lines of one kind of refused request."""
FRUSTUM_OF_RADIUS, THUMBNAIL_WIDTH = 0.06, 112
"""Size of a camera's frustum, in median distances of the cameras; pixels of the picture in it."""
THUMBNAIL_EVERY_S = 1.0
"""Between two thumbnails of a camera."""
THUMBNAIL_BUDGET_S = 0.03
"""For decoding thumbnails in a refresh; cameras take turns."""
SETTLE_S = 20.0
"""For this long the starting viewpoint follows cameras that report late, for visitors who have not moved."""
QUIET_S = 0.7
"""Cameras report one after the other: a viewpoint is chosen when no new one has reported for this long."""
ABOVE_CAMERAS_DEG, ELEVATION_DEG = 10.0, (18.0, 55.0)
"""A visitor's elevation exceeds that of the cameras by so much, within bounds."""
DISTANCE = 1.9
"""Of a visitor, in those of a median camera: three quarters of an arc of cameras are seen, and little of the space
behind them, which a field knows little of."""
POSE_NOISE = 0.02
"""Meters, and radians: a camera whose pose changes by less stands still."""
NETWORKS = {"ideal": (0.0, 0.0), "good": (30.0, 0.01), "bad": (400.0, 0.2), "blackout": (0.0, 1.0)}
"""Mean delay (ms) and loss of the conditions that a visitor chooses from: none; a home's network; a crowded mobile
one, with which a walking person has moved by half a meter before they are seen; nothing arrives."""
MAX_SLIDER_DELAY_MS = 2000
"""STALE_MS: beyond it, no color changes any more."""
SLIDER_SETTLES_S = 0.3
"""A slider that has stood still for so long is let go of."""
ANSWER_S = 3.0
"""For the emulator's answer: after a longer time a visitor presses again."""
STATUS_LAG_S = 1.0
"""Until the emulator's status tells of a change: it is written, and read, twice a second."""
SOLID = 0.5
"""From this opacity on a pixel has a depth."""
ERROR_GAIN = 4.0
"""Of differences, as in the report's figures: one of 10 % of the range is plain to see."""
AGE_VIEW_STEP = 4
"""Pixels from one point whose age is reckoned to the next: 9 cameras then take 12 ms of a processor at 480 rows."""
AGE_VIEW_LIGHT = 0.35
"""Least share of an age's color: the picture's shades fill the rest, so that shapes can be told."""
LABEL_PX = 10
"""Margin of the words on a large image."""
FLAT_SCORES, FLAT_MARGIN_DB = 20, 0.5
"""Latest scores that tell whether a picture is better than one mean color, and by how much it must be: whatever
shows the scene exceeds it by several dB."""
REFUSED_SHARE = 0.2
"""Of a camera's frames, from which on refusals explain a bad picture."""
LEAST_SCENE_PX = 320
"""Of the scene beside both panels; a phone, where they are below the scene, is as wide."""

# --- rendering for visitors (rendering) ---
RENDER_LEVELS = ((0.08, 0.5, 64, 240), (0.20, 0.2, 120, 480), (1.2, 0.15, 200, 720))
"""While the visitor moves, at rest, and at rest with nothing new to show: seconds for one image, largest share of all
time for such images, fewest and most rows (``DetailLevel``). An image of fewer rows is not worth its fixed cost, the
wait for a training step of the field to end."""
RENDER_LEAST_S = 0.03
"""Shortest budget for the image of a new publication: at a share of .2 that is seven pictures a second."""
RENDER_BAND_S = 0.1
"""Of a band of rows, between two of which an image may be abandoned."""
RENDER_MIN_GAP_S = RENDER_IDLE_S = 0.05
"""Between two images of a level at least; between two looks at what visitors need."""
RENDER_UNVISITED_S = 0.5
"""The same while nobody visits."""
RENDER_SETTLE_S = 0.25
"""A visitor who has not moved for this long is at rest."""
FIRST_ROWS, ROWS_CHANGE = 1.5, (0.7, 1.3)
"""Rows of a level's first image, in its fewest, and factors by which the next image's may change."""
PICTURE_JPEG_QUALITY = 85
STRIPE_PX, STRIPE_SHADE = 6, 0.7
"""Width and brightness of the stripes over what no camera has seen."""
UNSEEN_COARSE = 4
"""That is asked at so many times fewer pixels a side: it takes a few milliseconds then."""
DEPTH_PERCENTILES = (2, 98)
"""Of a picture's depth, that are its nearest and farthest colors."""

# --- panels and charts (panel, timelines, markup, controls, colors) ---
MAIN_PANEL_PX, SIDE_PANEL_PX = 372, 356
"""Widths."""
PAIR_PX, PAIR_JPEG_QUALITY = 640, 88
"""Of two images beside each other: their width together."""
THUMBNAIL_JPEG_QUALITY = 75
CHART_LINE_PX, CHART_HEIGHT_PX = 1.6, 104
CHART_POINTS = 300
"""More points than the chart has pixels would be sent but not seen."""
CHART_SAMPLES = 1200
"""Kept of ages and the channel's state."""
NAMED_CAMERAS = 3
"""That a sentence names, of those that an update left out."""
SNAPSHOT_NOTICE_S = 30.0
"""For which the path of a saved snapshot stays."""
SLIDER_STEP_MS = 10
"""Of the slider of delay."""
COLOR_STEPS = 24
"""Frustums change color in steps, so that an idle page sends almost nothing."""

# --- the starting viewpoint (viewpoint) ---
VERTICAL_FOV_DEG = 60.0
SCATTERED = 0.25
"""A shorter mean of unit vectors has no meaning: cameras surround the scene, or roll freely."""
AHEAD_OF_SPREAD, LEAST_AHEAD_M = 3.0, 1.0
"""Where optical axes do not meet, cameras look at a point so far ahead, in their mean distance from their middle."""

# --- threads and connections (page_thread, access_guard) ---
AFTER_ERROR_S = 1.0
"""Until a thread's next step, after one that failed."""
THREAD_END_S = 5.0
"""For a thread to end, when the page does."""
CLOSE_S = 2.0
"""For a visitor's browser to close a connection."""
