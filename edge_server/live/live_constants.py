"""Constants of the live edge server that no scenario sets."""

from __future__ import annotations

# --- frames that wait in the buffer (buffer) ---
# Most frames of a camera that wait for a field that wants every frame: half a second at 30 a second.
MOST_UNSELECTED = 16
# After this many takes without a frame of a camera, its next one goes first, however old (after a blackout).
LONGEST_WAIT = 16
AS_YOUNG_NS = 1_000_000  # ages, measured from the youngest frame, are compared in steps of this length
# Time constant that discounts the moving share of a camera's image by its frame's age when frames are ranked: about one
# frame period of `kitchen`, where it was chosen.
FADES_MS = 40.0

# --- taking frames in (field_updater, ingest) ---
# Share of a budget in seconds for taking in new frames, if the field wants every frame. When a field in layers uses up
# this share, motion is tracked from the fewest frames (``LEAST_ALIGNED``): `kitchen` lost no fidelity by that.
INTAKE_SHARE = 0.6
LEAST_TAKEN = 4  # fewest new frames to take in, however short the budget is
SILENT_SESSION_NS = 3 * 10**9  # a session that has sent nothing for this long is not that of a second node

# --- measured depth that cameras send (depth_in_image, ingest) ---
# Width and height of depth that is never too large, however small a scenario's images are: the sensors of RealSense and
# OAK cameras have 1280 columns at most.
DEPTH_SIDE_PX = 1280
# Depth pixels that the edge reprojects per image pixel: all of 848 x 480 for an image of 320 x 240. Without a bound,
# 1280 x 1280 in a small image took .3 to .5 s, and may be a payload of 133 bytes.
MAX_DEPTH_POINTS = 6
# Depth pixels that the edge reprojects into one image, however large: all of 848 x 480, every second row and column
# of 1280 x 720. Without a bound, 1280 x 1280 took .11 s a frame, and .55 s with a new lens.
MOST_DEPTH_MOVED = 1 << 19
# Cached rays of depth sensors' lenses, 12 bytes for each pixel that is reprojected: those of 24 lenses of 640 x 480
# or 8 of 1280 x 720. Bounded, because a hostile sender's lens may differ in each frame.
MAX_DEPTH_RAYS_BYTES = 96 << 20

# --- whether a camera moves (camera_motion) ---
APART_M, APART_DEG = 0.03, 5.0  # poses farther apart than one of these are two places of a camera
MOVES = 2  # a camera counts as moving once it has left this many places
IN_A_ROW = 2  # a camera has left a place after this many successive frames away from it

# --- keyframes of fields without keyframes of their own (keyframes) ---
NEAR_KEYFRAME = 0.5  # a camera leaving a keyframe replaces its image only within this share of the distance to the next
RESTARTS_BELOW = 16  # a field that began with fewer viewpoints restarts once their number has doubled

# --- the loop of updates (loop, server) ---
LONGEST_SLEEP_S = 0.2  # of the loop, before it checks the controls again
ALL_DAMAGED_S = 0.01  # wait for newer frames if every selected one is damaged
TOO_SHORT, TOO_SHORT_OF = 10, 30  # warn if this many of the latest TOO_SHORT_OF updates made no step
WARN_EVERY_S = 30.0  # between two warnings of one kind
# Longest wait at shutdown for the update in progress, without which there is no checkpoint. On a machine with a load
# of five times its cores, updates of ``ngp`` at 640 x 480 take 6 s, the longest 18. The launcher kills the server
# after GRACE_S of ``launcher_constants``, of which the checkpoint and the last renderings need some.
STOP_S = 20.0

# --- scores: which held-out frame shows the instant of an update (scoring.held_out) ---
# Time for which held-out frames are kept beyond the longest lag of moving pixels, so that the frame nearest to that
# lag is still available at low frame rates.
HISTORY_BEYOND_LAGS_MS = 1000.0
HISTORY_FRAMES = 128  # most held-out frames that are kept of a camera
MOST_PENDING = 8  # publications that wait for their truth: more means that no held-out frames arrive
# Most frame periods between the truth and the present: half of one, the rest is jitter of a real camera's clock.
GAP_PERIODS = 0.55

# --- scores: what they may cost (scoring.scoring_thread) ---
SCORING_NICE = 5  # niceness: scoring serves observers and gives way to the field's updates
WAITING_FRAMES = 256  # held-out frames that wait while one publication is scored; older ones are not needed
WAITING_PUBLICATIONS = 2  # publications that wait while another one is scored; the oldest of more is left out
OPEN_PUBLICATIONS = 16  # publications whose scores are being collected from all held-out cameras
# Between two measurements of the baseline, in publications; where nothing is held out, in scored ones.
BASELINE_EVERY = 5
MOST_SNAPSHOTS = 16  # snapshots of the field that are kept for held-out frames that arrive late
SILENT_CAMERA_NS = 2_000_000_000  # captures of a camera this far behind the others are not waited for
SHOWN_EVERY_S = 0.4  # largest mean time between two scores of what a held-out camera is shown
FULL_EVERY = 4  # one in this many scores of what is shown has all metrics, the others only PSNR
SCORING_SHARE = 0.03  # share of the cores' time that the thread may use: it refills an allowance
SHOWN_SHARE = 0.02  # part of that share, of the cores' time too, for scores of what is shown
ALLOWANCE_S = 1.0  # largest allowance, in CPU seconds
FIRST_ALLOWANCE_S = 0.2  # the first one is smaller: in its first seconds the field needs the cores
RESERVE_S = 0.1  # publications are scored only while so many CPU seconds are left for what is shown
# Additional share for rescoring all frames so far of moving held-out cameras, 30 ms each at 320 x 240; and number of
# them per scored publication, whose metrics cost some ten times as much.
LOOK_BACK_SHARE, LOOKS_A_SCORE = 0.03, 12

# --- files of a run (output.journal, output.recorder) ---
FINAL_AFTER = 32  # newer publications after which one without scores will not get any: a second of updates at arrivals
LINE_EVERY_S = 0.08  # between two lines of publications without scores, on average: there may be fifty a second
INTERVAL_SHARE = 0.01  # weight of the newest interval in their running mean
# Most bytes and messages in the recorder's queue: the disk may stall for seconds. A node's frames are some tens of
# kilobytes.
MOST_QUEUED_BYTES, MOST_QUEUED = 64 * 2**20, 4096
RECORD_EVERY_S = 0.05  # polling interval of the recorder's empty queue
MESSAGE_BYTES = 1024  # counted for a queued message in addition to its payloads

# --- the field (server) ---
FIELD_NICE = 5  # niceness of its workers, in a server that answers cameras meanwhile

# --- status and history of a run (server, state, ingest, grpc_services, best_update_time) ---
STATUS_PERIOD_S, AGES_PERIOD_S = 0.5, 0.2  # between two writes of the status; of the cameras' ages
SNAPSHOT_TIMEOUT_S = 30.0  # how long a snapshot request waits for the update in progress
MAX_SNAPSHOTS = 20  # in the folder of a run: further requests are refused until some are moved away
LAST_SCORES_S = 4.0  # at shutdown, for pending scores and all frames of moving held-out cameras: 64 take 2 s
UPDATE_TIMES, CHECK_TIMES = 4096, 4096  # latest durations of updates, and of frame checks, that percentiles cover
MOST_EVENTS = 200  # latest events that are kept: each is in every edge.json
SHOWN_OF = 30  # latest scored instants and updates that ``EdgeState.present`` averages
KEPT_PUBLICATIONS = 4096  # latest publications that ``EdgeState`` keeps
WATCH_S = 0.05  # polling interval of the operator service for new decisions; updates take hundreds of milliseconds
USUAL_SPEED_M_PER_S = 1.0  # assumed of a scene whose speed is not given (``best_update_time``): a person walking

# --- watchers of a run and of its metrics (grpc_services, output.guarded_http) ---
MAX_WATCHERS = 32  # of decisions at once; each polls the state twenty times a second
MAX_SCRAPES = 8  # open connections to the metrics, or to the preference page; a new one ends the oldest
SCRAPE_TIMEOUT_S = 5.0  # longest silence of such a connection

# --- connections and keys (keys_command, output.guarded_http, server) ---
CERTIFICATE_DAYS = 365  # for which a certificate of ``keys`` is valid
# Connections that wait to be accepted by an HTTP server: with the usual five, a client waits seconds during a flood.
WAITING_CONNECTIONS = 128
HTTP_LINGER_S = 2.0  # after an answer, further input is read for at most this long
GRPC_END_S = 1.0  # for the gRPC server to end when the edge shuts down
