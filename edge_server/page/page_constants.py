"""Constants of the live page; its levels of detail are in ``rendering``."""

from __future__ import annotations

# --- ages and their colors (colors, markup, diagnosis) ---
FRESH_MS = 50.0  # up to this age a frame has the freshest color
STALE_MS = 2000.0  # from this age on a frame has the stale color
COLOR_STEPS = 24  # of the scale between them: frustums change color in steps, so that an idle page sends almost nothing

# --- panels and notices (__init__, panel, markup, controls, access_guard) ---
REFRESH_S = 0.5  # between two refreshes of panels and scene
MAIN_PANEL_PX, SIDE_PANEL_PX = 372, 356  # widths of the two panels
# Least width of the scene beside both panels; a phone, where they are below the scene, is as wide.
LEAST_SCENE_PX = 320
AGE_PARTS_OF = 50  # latest publications over which the parts of the age are averaged
POSE_NOISE = 0.02  # meters, and radians: a camera whose pose changes by less counts as fixed
PAIR_PX, PAIR_JPEG_QUALITY = 640, 88  # truth and picture beside each other: their width together; quality, 0 to 100
NAMED_CAMERAS = 3  # most left-out cameras that a sentence names
NOTICE_S = 8.0  # how long the answer to a control is shown
SNAPSHOT_NOTICE_S = 30.0  # how long the path of a saved snapshot is shown
SAY_EVERY_S = 60.0  # between two log lines of one kind of refused request

# --- charts (timelines) ---
WINDOW_S = 120.0  # time span of the charts
CHART_LINE_PX, CHART_HEIGHT_PX = 1.6, 104  # width of a chart's lines; height of a chart
CHART_POINTS = 300  # most points of a line: more than the chart has pixels would be invisible
CHART_SAMPLES = 1200  # latest samples that are kept, of ages and of the channel's state each

# --- causes of a bad picture (diagnosis) ---
# Number of latest scores that decide whether a picture is better than one mean color, and the required margin: any
# picture that shows the scene exceeds it by several dB.
FLAT_SCORES, FLAT_MARGIN_DB = 20, 0.5
REFUSED_SHARE = 0.2  # share of a camera's frames, beyond which refusals explain a bad picture

# --- the network's control (network_control) ---
# Mean delay (ms) and loss of the conditions that a visitor may choose: none; a home network; a crowded mobile network,
# in which a walking person is shown half a meter behind; a network that delivers nothing.
NETWORKS = {"ideal": (0.0, 0.0), "good": (30.0, 0.01), "bad": (400.0, 0.2), "blackout": (0.0, 1.0)}
MAX_SLIDER_DELAY_MS = 2000  # end of the slider of delay, STALE_MS: beyond it, no color changes any more
SLIDER_STEP_MS = 10  # step of that slider
SLIDER_SETTLES_S = 0.3  # a slider that has not moved for this long counts as released
ANSWER_S = 3.0  # longest wait for the emulator's answer: beyond that, a visitor presses again
STATUS_LAG_S = 1.0  # until the emulator's status reflects a change: it is written, and read, twice a second

# --- display modes (display_modes) ---
SOLID = 0.5  # from this opacity on a pixel has a depth
DEPTH_PERCENTILES = (2, 98)  # percentiles of a picture's depth that get the nearest and farthest color
# Stride in pixels at which age is computed: 9 cameras then take 12 ms of processor time at 480 rows.
AGE_VIEW_STEP = 4
# Least weight of an age's color: the picture's shading fills the rest, so that shapes stay recognizable.
AGE_VIEW_LIGHT = 0.35
LABEL_PX = 10  # distance of labels from the left edge of an image; from its top, twice as much

# --- rendering for visitors (rendering, foxglove_live) ---
# Images while the visitor moves, at rest, and at rest with nothing new to show: seconds per image, largest share of all
# time, least and most rows. An image of fewer rows is not worth its fixed cost, the wait for the field's current
# training step.
DETAIL = ((0.08, 0.5, 64, 240), (0.2, 0.2, 120, 480), (1.2, 0.15, 200, 720))
RENDER_LEAST_S = 0.03  # shortest budget for the image of a new publication: at a share of .2, seven images a second
RENDER_BAND_S = 0.1  # of a band of rows: an image may be abandoned between two bands
RENDER_MIN_GAP_S = 0.05  # least time from one image of a level to the next: it spares network and browser
RENDER_IDLE_S = 0.05  # polling interval of what visitors need
RENDER_UNVISITED_S = 0.5  # polling interval without visitors
RENDER_SETTLE_S = 0.25  # a visitor who has not moved for this long is at rest
FIRST_ROWS = 1.5  # rows of the first image of a level, as a multiple of the fewest that the level allows
ROWS_CHANGE = (0.7, 1.3)  # least and largest factor from the rows of an image to those of the next of its level
PICTURE_JPEG_QUALITY = 85  # of the images that visitors, and subscribers in Foxglove, get; from 0 to 100
STRIPE_PX, STRIPE_SHADE = 6, 0.7  # width of the stripes over what no camera has seen; factor of their brightness
UNSEEN_COARSE = 4  # factor of the reduced resolution at which unseen places are computed, in a few milliseconds

# --- cameras in the scene (scene) ---
FRUSTUM_OF_RADIUS = 0.06  # size of a camera's frustum, as a share of the cameras' median distance
THUMBNAIL_WIDTH = 112  # pixels of the picture in a frustum
THUMBNAIL_JPEG_QUALITY = 75  # of that picture, from 0 to 100
THUMBNAIL_EVERY_S = 1.0  # between two thumbnails of a camera
THUMBNAIL_BUDGET_S = 0.03  # for decoding thumbnails in a refresh; cameras take turns

# --- the starting viewpoint (scene, viewpoint) ---
SETTLE_S = 20.0  # for this long it adapts to cameras that report late, for visitors who have not moved
# Cameras report one after the other: a viewpoint is chosen when no new one has reported for this long.
QUIET_S = 0.7
VERTICAL_FOV_DEG = 60.0  # initial vertical field of view of a visitor
ABOVE_CAMERAS_DEG, ELEVATION_DEG = 10.0, (18.0, 55.0)  # by which it is higher than the cameras; bounds of its elevation
# Distance of a visitor from the point they look at, relative to that of a median camera: shows three quarters of an arc
# of cameras, and little of the space behind them, of which a field knows little.
DISTANCE = 1.9
# A mean of unit vectors shorter than this is meaningless: cameras surround the scene, or roll freely.
SCATTERED = 0.25
# If optical axes do not meet, the assumed distance of the point that cameras look at: relative to their mean distance
# from their center, and at least.
AHEAD_OF_SPREAD, LEAST_AHEAD_M = 3.0, 1.0

# --- limits on visitors (access_guard, preferences) ---
MAX_VISITORS = 32  # at once. One who does not read costs the data sent first, some megabytes
VISITOR_TIMEOUT_S = 30.0  # how long sent data may stay unread: a slow line receives the first megabytes in that time
MAX_VISITOR_MESSAGE_BYTES = 2**16  # of one message: viewpoints, clicks and values of controls take less than a kilobyte
MAX_CLICKS_HZ = 50.0  # clicks on controls and cameras, and their burst: a number's arrow, held, makes 40
MAX_VIEW_SIDE_PX = 16384  # width and height of a visitor's window: more than any screen has
# Connections at once, of visitors and requests: a browser opens six. A new one ends the oldest request. With TLS the
# same number may be in their handshake, of which a new one ends the oldest.
MAX_PAGE_CONNECTIONS = 128
MAX_ANSWER_BYTES = 2**10  # body of an answer to the preference page: a hundred bytes would do

# --- ends of threads and connections (page_thread, access_guard) ---
AFTER_ERROR_S = 1.0  # until a thread's next step, after one that failed
THREAD_END_S = 5.0  # for a thread to end, when the page does
CLOSE_S = 2.0  # for a visitor's browser to close a connection
