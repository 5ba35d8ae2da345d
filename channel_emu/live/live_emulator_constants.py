"""Constants of the live emulator that somebody may want to change."""

# --- calls and their messages (proxy, call_flow) ---
MOST_CALLS = 1000  # open at once through ``channel-emu proxy``; each takes 30 kB
MOST_METHODS = 64  # with links of their own; all others share one
# MOST_READY: number of messages read ahead of the one being written; then the sender waits. MOST_BEHIND: behind a
# message that is still in the link, up to so many are read, because the link must decide about each at its arrival.
# Dropped ones are kept without their bytes.
MOST_READY, MOST_BEHIND = 64, 10_000

# --- frames to the edge (camera_stream, frame_proxy, live_link) ---
MAX_QUEUED_BYTES = 256 * 2**20  # of all frames inside the links: 2.5 s of a thousand cameras with 100 kB a second
MAX_OTHER_CALLS = 100  # open calls besides the streams of frames: clock exchanges, health, reflection
# Maximum number of a camera's unanswered frames. More than one, so that waiting for an answer does not delay the next
# frame; few, so that a stalled edge is noticed at once.
CREDITS = 8
# Answers to no frame that was sent, before the stream ends: a hostile edge would keep the emulator busy.
MOST_STRANGE = 100
FIRST_BACKOFF_S, MAX_BACKOFF_S = 0.1, 1.0  # pauses before a stream to the edge is opened again: first and longest
FIRST_WAIT_S = 2.0  # nodes are admitted when the streams to the edge are open, or after this long without them
WARN_AFTER_NS = 3 * 10**9  # the emulator warns once after so long without the edge
EXCHANGE_TIMEOUT_S = 5.0  # longest duration of a clock exchange that is passed on

# --- a running channel, changed by operators (channel_service) ---
MAX_SET_DELAY_MS = 10_000.0  # mean delay that may be set: with more, a run would show nothing but its own start
MAX_CHANNEL_CHANGES = 256  # that the status keeps, which is written twice a second; older ones are in the log

# --- shutdown, status and history of the emulator (proxy, histogram) ---
STOP_GRACE_S = 0.5  # for open calls to end when the emulator stops
REFRESH_EVERY_S = 0.5  # time between two writes of the status
SETTLED_POLL_S = 0.002  # polling interval of the wait until no message is inside a link
DRAWN_BINS, DRAWN_PERCENT = 50, 99.5  # of a histogram that is drawn: equal bins, up to this percentile
KEEP_PATH_NS = 60 * 10**9  # how much of the chain's past path is kept; no event is processed later than this

# --- threads and memory of the process (priority, channel_emu.cli, channel_emu.pytest_plugin) ---
# The event loop takes the interpreter's lock back from another thread after this long at most
# (``sys.setswitchinterval``).
SWITCH_INTERVAL_S = 0.0005
SLICE_NS = 100_000  # a thread that asks for short slices is scheduled sooner when it wakes (Linux 6.12 and later)
RETURNED_BYTES = 1 << 20  # freed blocks from this size on are returned to the system

# --- any protocol over TCP (tcp_proxy) ---
PIECE_BYTES = 16_384  # largest piece: each takes one service time of the channel
PIECES_BEHIND = 8  # most pieces of a direction of a connection inside the link
# Time after which a lost piece is sent again: the least of TCP's implementations (RFC 6298 asks for 1 s at first).
RESEND_AFTER_S = 0.2
MOST_CONNECTIONS = 256  # open at once; more are refused
CONNECT_TIMEOUT_S = 10.0  # longest wait for the server behind the emulator to accept a connection
