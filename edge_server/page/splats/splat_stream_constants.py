"""Constants of the splat stream."""

from __future__ import annotations

# --- what is sent (published, visitor) ---
CHUNK = 128  # static Gaussians sent together
# Newest knots of the motion: the display needs four, earlier ones serve a visitor whose messages arrive late.
KNOTS_SENT = 6

# --- how often (stream, published, visitor) ---
TICK_S = 0.03  # polling interval of the field's publications with visitors
IDLE_S = 0.5  # polling interval without visitors; a new visitor ends the wait
STATUS_EVERY_S = 0.5  # between two messages with cameras, ages and the line of text
# Between two moving sets: on moving pixels, one that is .18 s old, with new knots, matches the newest to 27 dB.
MOVING_EVERY_S = 0.1
STATIC_EVERY_S = 0.5  # interval of the search for changed static chunks
CHANGED_SHARE = 0.02  # a chunk is sent again once this share of its weight has changed noticeably
BUSY = 8.0  # pause before static records are made again, relative to the time they took: at most an eighth of a core
# Test of whether the static Gaussians are still the same: number of those compared, and the largest median movement in
# scene units.
SAMPLED, SAME_WITHIN = 512, 0.02
NEW_SET_EVERY_S = 1.0  # between two static sets with other Gaussians, as while a field grows: each is sent whole
# A new static set is cut so that the visitor's link takes it in this time, the largest Gaussians first.
NEW_SET_S = 3.0

# --- capacity of a visitor's link (visitor) ---
FIRST_WINDOW, LEAST_WINDOW, MOST_WINDOW = 8_192, 4_096, 2_000_000  # bytes under way to a visitor: at first, bounds
QUEUE_S = 0.08  # a link counts as full at this delay beyond the shortest round trip
# What bytes under way add to round trips is fitted: weight of all earlier round trips at each newer one, and share of
# the bytes under way by which they must vary for the fit.
KEPT_OF_ROUND_TRIPS, LEAST_SPREAD = 0.95, 0.05
OUTAGE = 4.0  # round trips are clipped to this multiple of the mean
BACK_OFF = 0.85  # least factor by which a window shrinks at an acknowledgement
FORGET_RTT_S = 30.0  # time window of the shortest round trip
UNDER_WAY = 4  # messages that share the window
LEAST_MESSAGE, MOST_MESSAGE = 2_400, 16_384  # bytes of one: a chunk and knots; a piece of the emulator's TCP
# Messages under way on a link whose round trips scatter. The emulator's TCP takes as long for a small piece as for 16
# kB: with many small messages it carries a twelfth of what it could.
SCATTERING_UNDER_WAY = 2
MOVING_SHARE = 0.6  # of the link, for moving sets: the smallest Gaussians that do not fit are left out
LEAST_MOVING = 64  # Gaussians of a moving set, however slow the link: below that, sets become less frequent instead
